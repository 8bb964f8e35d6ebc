/** How much happened along the timeline, and where its axis has ticks. */

import type { History } from "../history/types";
import { when } from "../ui/summary";

/** Changes of the map in each of some bins from the first to the last value. */
export function densityOf(history: History, first: number, last: number, byTime: boolean, bins: number): number[] {
  const width = (last - first) / bins;
  const count = new Array<number>(bins).fill(0);
  const add = (value: number) => {
    const bin = Math.floor((value - first) / width);
    if (bin >= 0 && bin <= bins) count[Math.min(bin, bins - 1)]++;
  };
  const { offset, stamp } = history.events;
  for (let row = 0; row < offset.length; row++) add(byTime ? stamp[row] : offset[row]);
  if (!byTime) for (const each of history.changes.offset) add(each);
  return count;
}

const [MINUTE, HOUR, DAY] = [60, 3600, 86_400];
const SECONDS = [
  1, 2, 5, 10, 15, 30, MINUTE, 2 * MINUTE, 5 * MINUTE, 10 * MINUTE, 15 * MINUTE, 30 * MINUTE,
  HOUR, 2 * HOUR, 3 * HOUR, 6 * HOUR, 12 * HOUR,
];

/** Round values between two, at most so many and one more; of time in UTC, with the day where they
 * span several. */
export function ticks(first: number, last: number, most: number, byTime: boolean): { value: number; text: string }[] {
  const least = (last - first) / Math.max(1, most);
  const step = (byTime ? SECONDS.find((each) => each >= least) : undefined) ?? (byTime ? DAY * round(least / DAY) : Math.max(1, round(least)));
  const days = last - first > DAY;
  const found = [];
  for (let number = Math.ceil(first / step); number * step <= last; number++) {
    const value = number * step;
    const text = byTime ? when(value).slice(step >= DAY ? 0 : days ? 5 : 11, step >= DAY ? 10 : days ? 16 : 19) : value.toLocaleString("en");
    found.push({ value, text });
  }
  return found;
}

/** The next of 1, 2, 5, 10, 20, … */
function round(least: number): number {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((digit) => digit * power).find((each) => each >= least * (1 - 1e-9)) ?? 10 * power;
}
