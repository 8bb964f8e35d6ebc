/** Runs as lanes of the timeline, and how much happened along each. */

import type { History } from "../history/types";
import type { Stamps } from "../model/moments";
import type { Axis } from "./axis";

/** More runs than this share lanes. */
export const MOST_LANES = 5;

export interface Run {
  number: number;
  lane: number;
  /** Offsets of its first and last keyframe, and the stamps of its earliest and latest. */
  offsets: [number, number];
  stamps: [number, number];
}

/** A lane for each run; where there are too many, the first lane that is free when a run begins. */
export function lanesOf(history: History): Run[] {
  const { run, offset, stamp } = history.keyframes;
  const found: Run[] = history.runIds.map((_, number) => ({ number, lane: number, offsets: [-1, -1], stamps: [Infinity, -Infinity] }));
  for (let each = 0; each < run.length; each++) {
    const { offsets, stamps } = found[run[each]];
    if (offsets[0] < 0) offsets[0] = offset[each];
    offsets[1] = offset[each];
    stamps[0] = Math.min(stamps[0], stamp[each]);
    stamps[1] = Math.max(stamps[1], stamp[each]);
  }
  const runs = found.filter(({ offsets }) => offsets[0] >= 0);
  if (runs.length <= MOST_LANES) return runs.map((each, lane) => ({ ...each, lane }));
  const ends = new Array<number>(MOST_LANES).fill(-Infinity);
  for (const each of [...runs].sort((a, b) => a.stamps[0] - b.stamps[0])) {
    const free = ends.findIndex((end) => end < each.stamps[0]);
    each.lane = free < 0 ? ends.indexOf(Math.min(...ends)) : free;
    ends[each.lane] = Math.max(ends[each.lane], each.stamps[1]);
  }
  return runs;
}

/** By lane, the number of changes of the map that events of its runs made in each of some bins of pixels. */
export function densityOf(history: History, runs: readonly Run[], axis: Axis, stamps: Stamps | null, left: number, bin: number, bins: number): Float64Array[] {
  const lanes = 1 + Math.max(0, ...runs.map(({ lane }) => lane));
  const laneOf = new Int32Array(history.runIds.length);
  for (const { number, lane } of runs) laneOf[number] = lane;
  const counts = Array.from({ length: lanes }, () => new Float64Array(bins));
  const { offset, run, stamp } = history.keyframes;
  const changed = history.changes.offset;
  let change = 0;
  for (let each = 0; each < offset.length; each++) {
    let count = 1;
    while (change < changed.length && changed[change] < offset[each]) change++;
    for (; changed[change] === offset[each]; change++) if (stamps === null) count++;
    const x = axis.xOf(stamps === null ? offset[each] + 1 : stamp[each]);
    const at = Math.floor((x - left) / bin);
    counts[laneOf[run[each]]][Math.max(0, Math.min(bins - 1, at))] += count;
  }
  return counts;
}
