/** When the first map was drawn, as `data-painted`; with `?bench` in the address a function that
 * moves the slider to W and answers with the milliseconds until the map is painted. */

import { painted } from "./map/MapCanvas";
import { goTo } from "./state/actions";
import * as store from "./state/store";

declare global {
  interface Window {
    mapfoldBench?: (at: number) => Promise<number>;
  }
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
  if (new URLSearchParams(location.search).has("bench")) window.mapfoldBench = timeOf;
}
