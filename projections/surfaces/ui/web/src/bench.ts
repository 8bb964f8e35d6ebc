/** When the first map was drawn, as `data-painted`; with `?bench` in the address a function that
 * measures the time from moving the slider to the painted map. */

import { painted } from "./map/MapCanvas";
import { goTo } from "./state/actions";
import * as store from "./state/store";

declare global {
  interface Window {
    mapfoldBench?: (moves: number) => Promise<number[]>;
  }
}

/** Milliseconds of each of some moves to moments all over the log; the same on every call. */
async function bench(moves: number): Promise<number[]> {
  const through = store.history.value?.through ?? 0;
  const taken: number[] = [];
  let seed = 12345;
  for (let move = 0; move < moves; move++) {
    seed = (seed * 1103515245 + 12345) % 2 ** 31;
    const at = Math.floor((seed / 2 ** 31) * through);
    taken.push(await timeOf(at));
  }
  return taken;
}

function timeOf(at: number): Promise<number> {
  if (at === store.at.value) return Promise.resolve(0);
  return new Promise((resolve) => {
    const start = performance.now();
    const done = () => {
      painted.delete(done);
      // A message comes after the frame has been handed on to be shown.
      const channel = new MessageChannel();
      channel.port1.onmessage = () => resolve(performance.now() - start);
      channel.port2.postMessage(null);
    };
    painted.add(done);
    goTo(at);
  });
}

export function keepBench() {
  const first = () => {
    if (store.map.value === null) return;
    document.documentElement.dataset["painted"] = performance.now().toFixed(1);
    painted.delete(first);
  };
  painted.add(first);
  if (new URLSearchParams(location.search).has("bench")) window.mapfoldBench = bench;
}
