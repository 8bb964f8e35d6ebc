/** The offsets worth stopping at: changes of the map's shape, merges, and the clock of playing. */

import type { History } from "../history/types";
import { rowsBefore } from "./map_at";

/** Kinds of events that a mark on the timeline shows; in the order of the legend. */
export const MARKED = [
  "place_founded",
  "place_merged",
  "merge_refused",
  "objects_merged",
  "object_missing",
  "object_moved",
  "correction",
  "rejected",
  "loss",
  "run_began",
] as const;
export type Marked = (typeof MARKED)[number];

export interface Mark {
  offset: number;
  kind: Marked;
  ref: number;
  stamp: number;
}

export interface Moments {
  marks: Mark[];
  /** W after each change of the map's shape, ascending, each once. */
  changes: Int32Array;
  merges: Int32Array;
  /** By event row, seconds of playing until then: pauses are shortened, time never runs back. */
  clock: Float64Array;
}

/** Longest pause between two events that playing keeps, in seconds. */
const LONGEST_PAUSE = 3;
const CHANGES: ReadonlySet<string> = new Set(MARKED.filter((kind) => kind !== "run_began"));

export function momentsOf(history: History): Moments {
  const { offset, stamp, kind, ref } = history.events;
  const marked = new Set<string>(MARKED);
  const marks: Mark[] = [];
  const clock = new Float64Array(offset.length);
  let [seconds, last] = [0, Number.NaN];
  for (let row = 0; row < offset.length; row++) {
    const name = history.eventKinds[kind[row]];
    if (marked.has(name)) {
      marks.push({
        offset: offset[row],
        kind: name as Marked,
        ref: ref[row],
        stamp: stamp[row],
      });
    }
    const pause = stamp[row] - last;
    if (pause > 0) seconds += Math.min(pause, LONGEST_PAUSE);
    if (!Number.isNaN(stamp[row])) last = stamp[row];
    clock[row] = seconds;
  }
  const after = (kinds: (mark: Mark) => boolean) =>
    Int32Array.from([...new Set(marks.filter(kinds).map((mark) => mark.offset + 1))].sort((a, b) => a - b));
  return {
    marks,
    changes: after((mark) => CHANGES.has(mark.kind)),
    merges: after((mark) => mark.kind === "place_merged"),
    clock,
  };
}

/** The first of `moments` after `at`, or the last before it; null if there is none. */
export function neighbour(moments: Int32Array, at: number, direction: 1 | -1): number | null {
  const row = direction === 1 ? rowsBefore(moments, at + 1) : rowsBefore(moments, at) - 1;
  return row >= 0 && row < moments.length ? moments[row] : null;
}

/** The next event's W, or the one before: offsets without an event are passed over. */
export function stepEvent(history: History, at: number, direction: 1 | -1): number {
  return Math.max(0, Math.min(history.through, at + direction));
}

/** W when `seconds` of playing have passed since `at`. */
export function playedTo(history: History, moments: Moments, at: number, seconds: number): number {
  const { offset } = history.events;
  const row = rowsBefore(offset, at);
  const from = row > 0 ? moments.clock[row - 1] : 0;
  const to = rowsBefore(moments.clock, from + seconds);
  if (to >= offset.length) return history.through;
  return Math.max(at, to === 0 ? 0 : offset[to - 1] + 1);
}

/** W as a time: up to and including the last event stamped then or earlier, wherever it stands; with a run the last keyframe of that. */
export class Stamps {
  /** Of all events that have one, ascending. */
  readonly sorted: Float64Array;
  private readonly through: Int32Array;
  readonly first: number;
  readonly last: number;

  constructor(
    private readonly history: History,
    private readonly run: number | null = null,
  ) {
    const { offset, stamp } = run === null ? history.events : history.keyframes;
    const rows = Array.from(offset.keys()).filter((row) => stamp[row] > 0 && (run === null || history.keyframes.run[row] === run));
    rows.sort((a, b) => stamp[a] - stamp[b]);
    this.sorted = Float64Array.from(rows, (row) => stamp[row]);
    this.through = new Int32Array(rows.length);
    let most = 0;
    rows.forEach((row, index) => {
      most = Math.max(most, offset[row] + 1);
      this.through[index] = most;
    });
    this.first = this.sorted[0] ?? 0;
    this.last = this.sorted[this.sorted.length - 1] ?? 0;
  }

  get any(): boolean {
    return this.sorted.length > 1 && this.last > this.first;
  }

  at(stamp: number): number {
    if (stamp >= this.last && this.run === null) return this.history.through;
    let [low, high] = [0, this.sorted.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.sorted[middle] <= stamp) low = middle + 1;
      else high = middle;
    }
    return low === 0 ? 0 : this.through[low - 1];
  }

  /** The stamp of the last event before W. */
  of(at: number): number {
    const { offset, stamp } = this.history.events;
    for (let row = rowsBefore(offset, at) - 1; row >= 0; row--) {
      if (stamp[row] > 0) return stamp[row];
    }
    return this.first;
  }

  /** The run whose keyframe is the last event before W; -1 if that is no keyframe. */
  runOf(at: number): number {
    const { offset, run } = this.history.keyframes;
    const row = rowsBefore(offset, at) - 1;
    return row >= 0 && offset[row] === at - 1 ? run[row] : -1;
  }
}
