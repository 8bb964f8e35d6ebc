/** What is different between two maps, keyframe by keyframe and thing by thing. */

import type { History } from "../history/types";
import { type MapState, NONE } from "./map_at";

export type Change = "new" | "gone" | "moved" | "changed";

export interface MapDifference {
  /** Ordinals of keyframes; those in both maps whose place is another one. */
  newKeyframes: number[];
  movedKeyframes: number[];
  places: Map<number, Change>;
  objects: Map<number, Change>;
  /** Objects of which the position moved by more than this shows. */
  shifts: { object: number; x0: number; y0: number; x1: number; y1: number }[];
}

const SMALLEST_SHIFT_M = 0.05;

/** What became of `before` in `after`; both are of one history. */
export function compareMoments(history: History, before: MapState, after: MapState): MapDifference {
  if (before.at > after.at) {
    const back = compareMoments(history, after, before);
    const turn = (change: Change): Change =>
      change === "new" ? "gone" : change === "gone" ? "new" : change;
    return {
      ...back,
      places: new Map([...back.places].map(([place, change]) => [place, turn(change)])),
      objects: new Map([...back.objects].map(([object, change]) => [object, turn(change)])),
      shifts: back.shifts.map(({ object, x0, y0, x1, y1 }) => ({ object, x0: x1, y0: y1, x1: x0, y1: y0 })),
    };
  }
  const newKeyframes: number[] = [];
  const movedKeyframes: number[] = [];
  for (let each = 0; each < after.keyframeCount; each++) {
    if (each >= before.keyframeCount) newKeyframes.push(each);
    else if (before.placeOf[each] !== after.placeOf[each]) movedKeyframes.push(each);
  }
  const places = new Map<number, Change>();
  for (let place = 0; place < history.placeIds.length; place++) {
    const was = before.standsAs[place] === place;
    const is = after.standsAs[place] === place;
    if (!was && is) places.set(place, "new");
    else if (was && !is) places.set(place, "gone");
    else if (is && (before.size[place] !== after.size[place] || before.name[place] !== after.name[place]))
      places.set(place, "changed");
  }
  const objects = new Map<number, Change>();
  const shifts: MapDifference["shifts"] = [];
  const { changes } = history;
  for (let object = 0; object < history.objectIds.length; object++) {
    const [was, is] = [before.objectRow[object], after.objectRow[object]];
    if (was === is) {
      if (was !== NONE && placeNow(history, before, was) !== placeNow(history, after, is)) {
        objects.set(object, "moved");
      }
      continue;
    }
    if (was === NONE) objects.set(object, "new");
    else if (is === NONE) objects.set(object, "gone");
    else {
      const [x0, y0] = [changes.x[was], changes.y[was]];
      const [x1, y1] = [changes.x[is], changes.y[is]];
      const shifted = Math.hypot(x1 - x0, y1 - y0) > SMALLEST_SHIFT_M;
      if (shifted) shifts.push({ object, x0, y0, x1, y1 });
      const relocated = placeNow(history, before, was) !== placeNow(history, after, is);
      objects.set(object, shifted || relocated ? "moved" : "changed");
    }
  }
  return { newKeyframes, movedKeyframes, places, objects, shifts };
}

/** The place of an object's row, followed through merges. */
export function placeNow(history: History, map: MapState, row: number): number {
  const place = history.changes.place[row];
  return place === NONE ? NONE : map.standsAs[place];
}
