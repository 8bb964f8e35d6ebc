/** The address bar holds the moment, the selection, the settings and the panel, behind the `#`. */

import { batch, effect } from "@preact/signals";
import * as store from "./store";

const WRITE_AFTER_MS = 250;
const KINDS: readonly string[] = ["place", "object", "keyframe", "merge"];

/** What the address says; `at` waits until the log is there. */
export function readAddress(hash: string) {
  const found = new URLSearchParams(hash.replace(/^#/, ""));
  const number = (name: string) => {
    const value = Number(found.get(name) ?? Number.NaN);
    return Number.isFinite(value) ? value : null;
  };
  const [kind, ...id] = (found.get("select") ?? "").split(":");
  const panel = found.get("panel");
  return {
    at: number("at"),
    selection: KINDS.includes(kind) && id.length > 0 ? ({ kind, id: id.join(":") } as store.Thing) : null,
    panel: panel === "none" ? null : store.PANELS.find((each) => each === panel),
    compareWith: number("with"),
    eps: number("eps_m"),
    minSamples: number("min_samples"),
    byTime: found.get("clock") === "time",
    known: found.get("known") === "then" ? ("then" as const) : ("now" as const),
    floor: found.get("floor"),
  };
}

export function applyAddress(hash: string) {
  const found = readAddress(hash);
  batch(() => {
    store.selection.value = found.selection;
    if (found.panel !== undefined) store.panel.value = found.panel;
    store.compareWith.value = found.compareWith;
    store.otherEps.value = found.eps;
    store.otherMinSamples.value = found.minSamples;
    if (found.eps !== null || found.minSamples !== null) store.compareMode.value = "settings";
    store.byTime.value = found.byTime;
    store.known.value = found.known;
    const floors = store.history.value?.floors ?? [];
    store.floor.value = found.floor === null ? null : floors.indexOf(found.floor);
    const through = store.history.value?.through ?? 0;
    const at = found.at === null ? through : Math.max(0, Math.min(through, Math.round(found.at)));
    store.at.value = store.restedAt.value = at;
    store.live.value = found.at === null;
  });
}

/** Without a moment while the page follows the log, unless the link is to be shared. */
export function writtenAddress(still = false): string {
  const found = new URLSearchParams();
  if (still || !store.live.value) found.set("at", String(store.at.value));
  const thing = store.selection.value;
  if (thing !== null) found.set("select", `${thing.kind}:${thing.id}`);
  found.set("panel", store.panel.value ?? "none");
  if (store.panel.value === "compare") {
    if (store.compareMode.value === "moments") {
      if (store.compareWith.value !== null) found.set("with", String(store.compareWith.value));
    } else {
      if (store.otherEps.value !== null) found.set("eps_m", String(store.otherEps.value));
      if (store.otherMinSamples.value !== null) found.set("min_samples", String(store.otherMinSamples.value));
    }
  }
  if (store.byTime.value) found.set("clock", "time");
  if (store.known.value === "then") found.set("known", "then");
  if (store.floor.value !== null) found.set("floor", store.history.value?.floors[store.floor.value] ?? "-");
  return `#${found.toString()}`;
}

/** Keeps the address up to date; browsers refuse more than some hundred changes a minute. */
export function keepAddress() {
  let timer = 0;
  effect(() => {
    const written = writtenAddress();
    clearTimeout(timer);
    if (store.history.value === null) return; // what the address says is not shown yet
    timer = window.setTimeout(() => {
      if (location.hash !== written) window.history.replaceState(null, "", written);
    }, WRITE_AFTER_MS);
  });
  window.addEventListener("hashchange", () => applyAddress(location.hash));
}
