/** Corrections by dragging on the map, from one place or object to another; each is a proposal with its preview. */

import { signal } from "@preact/signals";
import type { History } from "../history/types";
import type { Picked } from "../map/pick";
import type { MapState } from "../model/map_at";
import { isolated, keyframeId, keyframeTitle, label, objectClass, placeTitle } from "../model/names";
import type { Proposal } from "./proposals";

/** Whether a drag that begins on a thing corrects the map instead of moving the view. */
export const byDragging = signal(false);
/** The drag under way, metres. */
export const dragged = signal<{ x0: number; y0: number; x1: number; y1: number } | null>(null);

export interface Grip {
  x: number;
  y: number;
  picked: Picked;
}

/** What dropping there proposes, and that in words; null for nothing. */
export function dropped(history: History, map: MapState, from: Grip, to: Grip | null): { says: string; proposal: () => Proposal } | null {
  if (to === null) return null;
  const quoted = (text: string) => `“${isolated(label(text, 24))}”`;
  if (from.picked.thing.kind === "object") {
    if (to.picked.thing.kind !== "object" || from.picked.number === to.picked.number) return null;
    const [one, other] = [objectClass(history, map, from.picked.number), objectClass(history, map, to.picked.number)];
    return one === other
      ? { says: "Both are one object", proposal: () => ({ kind: "same-object", arguments: [from.picked.thing.id, to.picked.thing.id] }) }
      : { says: `Call every ${quoted(one)} ${quoted(other)}`, proposal: () => ({ kind: "relabel", arguments: [`${one}=${other}`] }) };
  }
  const [one, other] = [placeOf(map, from.picked), placeOf(map, to.picked)];
  if (one < 0 || other < 0) return null;
  const name = (place: number) => isolated(label(placeTitle(history, map, place), 24));
  if (one !== other) return { says: `Join ${name(one)} with ${name(other)}`, proposal: () => ({ kind: "join", arguments: [history.placeIds[one], history.placeIds[other]] }) };
  const ends = () => [from, to].map(({ x, y }) => keyframeTitle(keyframeId(history, nearest(history, map, one, x, y))));
  return { says: `Cut ${name(one)} between here and there`, proposal: () => ({ kind: "keep-apart", arguments: ends() }) };
}

function placeOf(map: MapState, { thing, number }: Picked): number {
  return thing.kind === "place" ? number : thing.kind === "keyframe" ? map.placeOf[number] : -1;
}

/** The keyframe of a place that is nearest to a point. */
function nearest(history: History, map: MapState, place: number, x: number, y: number): number {
  const { x: xs, y: ys } = history.keyframes;
  let [found, best] = [-1, Infinity];
  for (let each = 0; each < map.keyframeCount; each++) {
    if (map.placeOf[each] !== place) continue;
    const away = Math.hypot(xs[each] - x, ys[each] - y);
    if (away < best) [found, best] = [each, away];
  }
  return found;
}
