/** Moves W while playing, and sets `restedAt` when W has rested. */

import { effect } from "@preact/signals";
import { playedTo } from "../model/moments";
import * as store from "./store";

const REST_MS = 200;

export function keepPlaying() {
  let [frame, last, seconds, from] = [0, 0, 0, 0];
  const advance = (now: number) => {
    const [history, moments] = [store.history.value, store.moments.value];
    if (!store.playing.value || history === null || moments === null) return;
    seconds += ((now - last) / 1000) * store.speed.value;
    last = now;
    const to = playedTo(history, moments, from, seconds);
    if (to !== store.at.value) store.at.value = to;
    if (to >= history.through) store.playing.value = false;
    else frame = requestAnimationFrame(advance);
  };
  effect(() => {
    cancelAnimationFrame(frame);
    if (!store.playing.value) return;
    void store.speed.value;
    [last, seconds, from] = [performance.now(), 0, store.at.peek()];
    frame = requestAnimationFrame(advance);
  });
}

export function keepRested() {
  let timer = 0;
  effect(() => {
    const at = store.at.value;
    clearTimeout(timer);
    timer = window.setTimeout(() => {
      store.restedAt.value = at;
    }, REST_MS);
  });
}
