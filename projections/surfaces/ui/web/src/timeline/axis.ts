/** The axis of the timeline: events one after the other, or time, of which what was idle is folded. */

import { rowsBefore } from "../model/map_at";
import { when } from "../ui/summary";

/** A pause that may be idle time, seconds, and its least share of the time that was not idle. */
const PAUSE_S = 60;
const PAUSE_SHARE = 0.05;
const FOLD_PIXELS = 22;
/** Share of the axis that all folds together take at most. */
const FOLDS_SHARE = 0.3;

/** The first and last stamps between which no pause is long, of stamps that ascend. */
export function busySpans(stamps: ArrayLike<number>): [number, number][] {
  let busy = 0;
  for (let each = 1; each < stamps.length; each++) busy += Math.min(stamps[each] - stamps[each - 1], PAUSE_S);
  const idle = Math.max(PAUSE_S, PAUSE_SHARE * busy);
  const spans: [number, number][] = [];
  for (let each = 0; each < stamps.length; each++) {
    const last = spans[spans.length - 1];
    if (last === undefined || stamps[each] - last[1] > idle) spans.push([stamps[each], stamps[each]]);
    else last[1] = stamps[each];
  }
  return spans;
}

export interface Tick {
  x: number;
  text: string;
  /** Whether the text begins there, instead of standing below the middle. */
  begins: boolean;
}

/** Values along pixels, straight within each span and within each fold between two. */
export class Axis {
  private readonly values: number[] = [];
  private readonly pixels: number[] = [];
  private readonly perPixel: number;

  constructor(private readonly spans: readonly (readonly [number, number])[], left: number, width: number) {
    const folds = Math.max(0, spans.length - 1);
    const length = spans.reduce((sum, [first, last]) => sum + last - first, 0);
    const fold = folds === 0 ? 0 : length === 0 ? width / folds : Math.min(FOLD_PIXELS, (FOLDS_SHARE * width) / folds);
    this.perPixel = length / Math.max(1, width - folds * fold);
    let x = left;
    spans.forEach(([first, last], index) => {
      if (index > 0) x += fold;
      this.values.push(first, last);
      this.pixels.push(x, (x += this.perPixel === 0 ? 0 : (last - first) / this.perPixel));
    });
  }

  xOf(value: number): number {
    return along(this.values, this.pixels, value);
  }

  valueOf(x: number): number {
    return along(this.pixels, this.values, x);
  }

  /** What lies between the spans: from where to where on the screen, and how much of time it is. */
  get folds(): { x0: number; x1: number; seconds: number }[] {
    return this.spans.slice(1).map(([first], index) => ({ x0: this.pixels[2 * index + 1], x1: this.pixels[2 * index + 2], seconds: first - this.spans[index][1] }));
  }

  /** Round numbers of events. */
  eventTicks(apart: number): Tick[] {
    const step = Math.max(1, round(apart * this.perPixel));
    return this.multiples(step, this.spans[0]).map((value) => ({ x: this.xOf(value), text: value.toLocaleString("en"), begins: false }));
  }

  /** The beginnings of spans, with the day where there are several, and round times of UTC between. */
  timeTicks(apart: number): Tick[] {
    const least = apart * this.perPixel;
    const step = SECONDS.find((each) => each >= least) ?? DAY * round(least / DAY);
    const text = (value: number, from: number, to: number) => when(value).slice(from, to);
    const days = this.values[this.values.length - 1] - this.values[0] > DAY;
    const year = text(this.values[0], 0, 4) !== text(this.values[this.values.length - 1], 0, 4);
    const starts = days ? this.spans.map(([first]) => ({ x: this.xOf(first), text: text(first, year ? 0 : 5, 16), begins: true })) : [];
    const rounds = this.spans.flatMap((span) =>
      this.multiples(step, span).map((value) => ({ x: this.xOf(value), text: step >= DAY ? text(value, 5, 10) : text(value, 11, step < MINUTE ? 19 : 16), begins: false })),
    );
    return [...starts, ...rounds];
  }

  private multiples(step: number, [first, last]: readonly [number, number]): number[] {
    const found = [];
    for (let number = Math.ceil(first / step); number * step <= last; number++) found.push(number * step);
    return found;
  }
}

/** Where `at` is, on the way from one of `from` to the next, between the same two of `to`. */
function along(from: readonly number[], to: readonly number[], at: number): number {
  const next = Math.max(1, Math.min(from.length - 1, rowsBefore(from, at)));
  const whole = from[next] - from[next - 1];
  const share = whole > 0 ? (at - from[next - 1]) / whole : at > from[next] ? 1 : 0;
  return to[next - 1] + Math.max(0, Math.min(1, share)) * (to[next] - to[next - 1]);
}

const [MINUTE, HOUR, DAY] = [60, 3600, 86_400];
const SECONDS = [
  1, 2, 5, 10, 15, 30, MINUTE, 2 * MINUTE, 5 * MINUTE, 10 * MINUTE, 15 * MINUTE, 30 * MINUTE,
  HOUR, 2 * HOUR, 3 * HOUR, 6 * HOUR, 12 * HOUR, DAY,
];

/** The next of 1, 2, 5, 10, 20, … */
function round(least: number): number {
  const power = 10 ** Math.floor(Math.log10(Math.max(least, 1)));
  return [1, 2, 5, 10].map((digit) => digit * power).find((each) => each >= least * (1 - 1e-9)) ?? 10 * power;
}

/** `3 days`: about how long. */
export function lengthOf(seconds: number): string {
  const units: [number, string][] = [[365 * DAY, "year"], [30 * DAY, "month"], [DAY, "day"], [HOUR, "hour"], [MINUTE, "minute"], [1, "second"]];
  const [size, name] = units.find(([each]) => seconds >= 2 * each) ?? units[units.length - 1];
  return `${Math.round(seconds / size)} ${name}s`;
}
