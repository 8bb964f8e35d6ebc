/**
 * Which colour of the palette each place has, at all times the same: places that were ever adjacent,
 * or that became one, have different ones as far as there are enough.
 */

import type { History } from "../history/types";

const known = new WeakMap<History, { count: number; colours: Uint8Array }>();

export function placeColours(history: History, count: number): Uint8Array {
  const found = known.get(history);
  if (found?.count === count) return found.colours;
  const near: Set<number>[] = history.placeIds.map(() => new Set());
  const link = (a: number, b: number) => {
    near[a].add(b);
    near[b].add(a);
  };
  history.pairs.a.forEach((a, row) => link(a, history.pairs.b[row]));
  history.merges.survivor.forEach((survivor, row) => link(survivor, history.merges.absorbed[row]));
  const colours = new Uint8Array(history.placeIds.length);
  for (let place = 0; place < colours.length; place++) {
    const used = new Set([...near[place]].filter((other) => other < place).map((other) => colours[other]));
    let colour = place % count;
    for (let step = 0; step < count && used.has(colour); step++) colour = (colour + 1) % count;
    colours[place] = colour;
  }
  known.set(history, { count, colours });
  return colours;
}
