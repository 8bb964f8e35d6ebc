/** Which things are emphasised: what is selected, under the pointer, or part of an answer. */

import { findKeyframe, findObject, findPlace } from "../model/names";
import type { Thing } from "../state/store";
import type { Scene } from "./scene";

function names(scene: Scene, thing: Thing | null, place: number): boolean {
  return thing?.kind === "place" && scene.map.standsAs[findPlace(scene.history, thing.id)] === place;
}

export function isPlaceLit(scene: Scene, place: number): boolean {
  return (
    names(scene, scene.selection, place) ||
    names(scene, scene.hovered, place) ||
    (scene.lost?.places.has(place) ?? false)
  );
}

export function litObject(scene: Pick<Scene, "history" | "map">, thing: Thing | null): number {
  if (thing?.kind !== "object") return -1;
  const object = findObject(scene.history, thing.id);
  return object < 0 ? -1 : scene.map.objectStandsAs[object];
}

export function litKeyframe(scene: Scene, thing: Thing | null): number {
  if (thing?.kind !== "keyframe") return -1;
  const keyframe = findKeyframe(scene.history, thing.id);
  return keyframe < scene.map.keyframeCount ? keyframe : -1;
}
