/** What is different between two maps, keyframe by keyframe and thing by thing. */

import type { History } from "../history/types";
import { type MapState, NONE, rowsBefore } from "./map_at";

export type Change = "new" | "gone" | "joined" | "moved" | "changed";

export interface MapDifference {
  /** Ordinals of keyframes; those in both maps whose place is another one. */
  newKeyframes: number[];
  movedKeyframes: number[];
  places: Map<number, Change>;
  objects: Map<number, Change>;
  /** Objects that the fold relocated by more than both errors: that moved, farthest first. */
  shifts: { object: number; x0: number; y0: number; x1: number; y1: number }[];
}

/** 99 % of the squared normalised distances of two estimates of one position. */
const BEYOND = 9.21;

/** What became of `before` in `after`; both are of one history. */
export function compareMoments(history: History, before: MapState, after: MapState): MapDifference {
  if (before.at > after.at) {
    const back = compareMoments(history, after, before);
    const turn = (change: Change): Change =>
      change === "new" ? "gone" : change === "gone" || change === "joined" ? "new" : change;
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
  const relocated = relocatedBetween(history, before.at, after.at);
  for (let object = 0; object < history.objectIds.length; object++) {
    const [was, is] = [before.objectRow[object], after.objectRow[object]];
    if (was === is) continue;
    if (was === NONE) objects.set(object, "new");
    else if (is === NONE) objects.set(object, after.objectStandsAs[object] === NONE ? "gone" : "joined");
    else {
      const [x0, y0] = [changes.x[was], changes.y[was]];
      const [x1, y1] = [changes.x[is], changes.y[is]];
      const moved = relocated.has(object) && isBeyondErrors(history, was, is);
      if (moved) shifts.push({ object, x0, y0, x1, y1 });
      objects.set(object, moved ? "moved" : "changed");
    }
  }
  const far = ({ x0, y0, x1, y1 }: MapDifference["shifts"][number]) => Math.hypot(x1 - x0, y1 - y0);
  shifts.sort((a, b) => far(b) - far(a));
  return { newKeyframes, movedKeyframes, places, objects, shifts };
}

/** Objects that the fold found elsewhere between two moments. */
function relocatedBetween(history: History, start: number, end: number): Set<number> {
  const { offset, kind, ref } = history.events;
  const moved = history.eventKinds.indexOf("object_moved");
  const found = new Set<number>();
  for (let row = rowsBefore(offset, start), last = rowsBefore(offset, end); row < last; row++) {
    if (kind[row] === moved) found.add(ref[row]);
  }
  return found;
}

/** Whether two estimates of an object differ by more than their errors explain. */
function isBeyondErrors(history: History, one: number, other: number): boolean {
  const { x, y, xx: vxx, xy: vxy, yy: vyy } = history.changes;
  const [dx, dy] = [x[other] - x[one], y[other] - y[one]];
  const [xx, xy, yy] = [vxx[one] + vxx[other], vxy[one] + vxy[other], vyy[one] + vyy[other]];
  return yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy > BEYOND * (xx * yy - xy * xy);
}

/** The place of an object's row, followed through merges. */
export function placeNow(history: History, map: MapState, row: number): number {
  const place = history.changes.place[row];
  return place === NONE ? NONE : map.standsAs[place];
}
