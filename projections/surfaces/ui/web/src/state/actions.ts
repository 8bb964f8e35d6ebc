/** What a person does: go to a moment, select, step, open a panel. */

import { batch } from "@preact/signals";
import { findKeyframe, findObject, findPlace } from "../model/names";
import { floorOfObject, floorOfPlace } from "../model/floors";
import { rowsBefore } from "../model/map_at";
import { neighbour, stepEvent } from "../model/moments";
import * as store from "./store";

export function goTo(at: number) {
  const through = store.history.value?.through ?? 0;
  const wanted = Math.max(0, Math.min(through, Math.round(at)));
  batch(() => {
    store.at.value = wanted;
    if (wanted < through) store.live.value = false;
  });
}

/** The moment at which what the event at `offset` did shows. */
export function showEvent(offset: number) {
  store.playing.value = false;
  goTo(offset + 1);
}

export function stepBy(kind: "event" | "change" | "merge", direction: 1 | -1): boolean {
  const [history, moments, at] = [store.history.value, store.moments.value, store.at.value];
  if (history === null || moments === null) return false;
  store.playing.value = false;
  const wanted =
    kind === "event"
      ? stepEvent(history, at, direction)
      : neighbour(kind === "merge" ? moments.merges : moments.changes, at, direction);
  if (wanted === null || wanted === at) return false;
  goTo(wanted);
  if (kind === "merge") select({ kind: "merge", id: String(wanted - 1) });
  return true;
}

export function select(thing: store.Thing | null, open = false) {
  batch(() => {
    store.selection.value = thing;
    const floor = thing === null ? null : floorOf(thing);
    if (store.shownFloor.value !== null && floor !== null && floor !== store.shownFloor.value) store.floor.value = floor;
    if (open && thing !== null) store.panel.value = "why";
  });
}

export function openPanel(name: store.PanelName | null) {
  if (name === null || store.PANELS.includes(name)) store.panel.value = name;
}

export function togglePlay() {
  const through = store.history.value?.through ?? 0;
  batch(() => {
    if (!store.playing.value && store.at.value >= through) store.at.value = 0;
    store.playing.value = !store.playing.value;
    if (store.playing.value) store.live.value = false;
  });
}

export function goLive(on: boolean) {
  batch(() => {
    store.live.value = on;
    if (on) {
      store.playing.value = false;
      store.at.value = store.history.value?.through ?? 0;
    }
  });
}

function floorOf({ kind, id }: store.Thing): number | null {
  const history = store.history.value;
  if (history === null) return null;
  const { keyframes, merges } = history;
  const floor = {
    place: () => floorOfPlace(history, findPlace(history, id)),
    object: () => floorOfObject(history, findObject(history, id)),
    keyframe: () => keyframes.floor[findKeyframe(history, id)],
    merge: () => keyframes.floor[merges.keyframe[merges.offset.indexOf(Number(id))]],
  }[kind]();
  return floor ?? null;
}

/** Where a thing is in the map now, metres; null where it is not. */
export function positionOf(thing: store.Thing): [number, number] | null {
  const [history, map] = [store.history.value, store.map.value];
  if (history === null || map === null) return null;
  switch (thing.kind) {
    case "place": {
      const place = findPlace(history, thing.id);
      const now = place < 0 ? -1 : map.standsAs[place];
      return now < 0 ? null : [map.x[now], map.y[now]];
    }
    case "object": {
      const object = findObject(history, thing.id);
      const row = object < 0 || map.objectStandsAs[object] < 0 ? -1 : map.objectRow[map.objectStandsAs[object]];
      return row < 0 ? null : [history.changes.x[row], history.changes.y[row]];
    }
    case "keyframe": {
      const keyframe = findKeyframe(history, thing.id);
      return keyframe < 0 ? null : pose(history.keyframes, keyframe);
    }
    case "merge": {
      const row = rowsBefore(history.merges.offset, Number(thing.id));
      return history.merges.offset[row] === Number(thing.id)
        ? pose(history.keyframes, history.merges.keyframe[row])
        : null;
    }
  }
}

function pose(keyframes: { x: Float32Array; y: Float32Array }, keyframe: number): [number, number] | null {
  const [x, y] = [keyframes.x[keyframe], keyframes.y[keyframe]];
  return Number.isNaN(x) ? null : [x, y];
}
