/** Loads the log and its history, again when it grows; whatever goes wrong becomes a sentence. */

import { batch, effect, signal } from "@preact/signals";
import { ApiError, LOST, address, getBinary, getJson, watchServer } from "../api/client";
import type { LogInfo } from "../api/types";
import { decodeHistory } from "../history/decode";
import type { History } from "../history/types";
import { showNotice } from "./pointer";
import * as store from "./store";
import { applyAddress } from "./url";

const AGAIN_MS = 1500;
/** Refusals that may be over a moment later. */
const PASSING: ReadonlySet<string> = new Set([LOST, "too_much", "log"]);

export const progress = signal<{ folded: number; events: number } | null>(null);

export async function load() {
  watchServer((reached) => {
    store.serverLost.value = !reached;
  });
  const watching = watchFold();
  try {
    const answer = await getBinary("/api/history");
    const info = await getJson<LogInfo>("/api/log");
    batch(() => {
      store.log.value = info;
      store.history.value = decodeHistory(answer);
      store.failure.value = null;
      applyAddress(location.hash);
    });
  } catch (error) {
    store.failure.value = sentence(error);
    if (error instanceof ApiError && PASSING.has(error.kind)) setTimeout(() => void load(), AGAIN_MS);
  } finally {
    watching();
  }
}

/** While the server folds the log for the first time, how far it is. */
function watchFold(): () => void {
  let on = true;
  const look = async () => {
    if (!on) return;
    try {
      const info = await getJson<LogInfo>("/api/log");
      if (!on) return;
      store.log.value ??= info;
      const { loading } = info;
      progress.value = loading === undefined || loading.done ? null : loading;
    } catch {
      // `load` itself reports it.
    }
    setTimeout(() => void look(), 400);
  };
  void look();
  return () => {
    on = false;
    progress.value = null;
  };
}

let growing = false;
let again = false;

/** Adds what was recorded since; loads all anew if the past has changed. */
export async function grow() {
  const before = store.history.value;
  if (before === null) return; // `load` is at it
  if (growing) {
    again = true;
    return;
  }
  growing = true;
  try {
    const known_at = store.shownKnownAt.value;
    let next = decodeHistory(await getBinary(address("/api/history", { from: before.through, known_at })), before);
    if (next.state !== before.state || next.through < before.through) next = decodeHistory(await getBinary(address("/api/history", { known_at })));
    kept.clear();
    const info = await getJson<LogInfo>("/api/log");
    if (store.history.value !== before) {
      again = true; // meanwhile another history is shown: of other knowledge
      return;
    }
    batch(() => {
      store.history.value = next;
      store.log.value = info;
      store.failure.value = null;
      if (store.live.value) store.at.value = next.through;
      else store.at.value = Math.min(store.at.value, next.through);
    });
  } catch (error) {
    if (!(error instanceof ApiError && error.kind === LOST)) store.failure.value = sentence(error);
  } finally {
    growing = false;
    if (again) {
      again = false;
      void grow();
    }
  }
}

/** Histories under what was known at another time, by the offset of `wantedKnownAt`. */
const kept = new Map<number | null, History>();
const MOST_KEPT = 4;

/** Shows the history that knows what is wanted; until it is there the one before stays. */
export function keepKnown() {
  effect(() => {
    const wanted = store.wantedKnownAt.value;
    const before = store.history.value;
    if (before === null || wanted === store.shownKnownAt.value) return;
    kept.set(store.shownKnownAt.peek(), before);
    if (kept.size > MOST_KEPT) kept.delete([...kept.keys()][0]);
    const show = (next: History) => {
      if (store.wantedKnownAt.peek() !== wanted || next.through < (store.history.peek()?.through ?? 0)) return;
      batch(() => {
        store.history.value = next;
        store.shownKnownAt.value = wanted;
      });
    };
    const found = kept.get(wanted);
    if (found !== undefined) queueMicrotask(() => show(found));
    else {
      getBinary(address("/api/history", { known_at: wanted })).then(
        (answer) => show(decodeHistory(answer)),
        (error: unknown) => showNotice(sentence(error)),
      );
    }
  });
}

export function sentence(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}
