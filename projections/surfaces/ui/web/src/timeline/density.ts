/** How much happened along the timeline: changes of the map in each of some bins. */

import type { History } from "../history/types";
import type { Stamps } from "../model/moments";

export interface Density {
  x: number[];
  count: number[];
}

export function densityOf(history: History, stamps: Stamps, byTime: boolean, bins: number): Density {
  const [first, last] = byTime ? [stamps.first, stamps.last] : [0, Math.max(1, history.through)];
  const width = (last - first) / bins || 1;
  const count = new Array<number>(bins).fill(0);
  const add = (value: number) => {
    const bin = Math.floor((value - first) / width);
    if (bin >= 0 && bin <= bins) count[Math.min(bin, bins - 1)]++;
  };
  const { offset, stamp } = history.events;
  for (let row = 0; row < offset.length; row++) add(byTime ? stamp[row] : offset[row]);
  if (!byTime) for (const each of history.changes.offset) add(each);
  return { x: count.map((_, bin) => first + (bin + 0.5) * width), count };
}
