/** The address bar holds all that the page shows, behind the `#`: a link is a moment. */

import { batch, effect } from "@preact/signals";
import { showBox, viewBox } from "../map/MapCanvas";
import type { Bounds } from "../model/regions";
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
    beside: found.has("beside"),
    settings: found.get("compare") === "settings",
    asked: { what: found.get("what") ?? "", room: found.get("in") ?? "", every: found.has("once") },
    sorted: sortedBy(found.get("sort")),
    wayFrom: found.get("from"),
    condition: found.get("if") ?? "",
    layers: layersOf(found.get("layers")),
    box: boxOf(found.get("box")),
    eps: number("eps_m"),
    minSamples: number("min_samples"),
    byTime: found.get("clock") === "time",
    known: found.get("known") === "then" ? ("then" as const) : ("now" as const),
    floor: found.get("floor"),
  };
}

/** `-seen` is by that column downwards, as at first. */
function sortedBy(text: string | null) {
  const by = store.COLUMNS.find((each) => text?.replace("-", "") === each) ?? "seen";
  return { by, down: text === null || text.startsWith("-") };
}

/** The names of all layers shown. */
function layersOf(text: string | null) {
  if (text === null) return store.LAYERS;
  const shown = text.split(",");
  return Object.fromEntries(Object.keys(store.LAYERS).map((name) => [name, shown.includes(name)])) as typeof store.LAYERS;
}

/** Two corners in metres of the map frame. */
function boxOf(text: string | null): Bounds | null {
  const [x0, y0, x1, y1] = text?.split(",").map(Number) ?? [];
  return [x0, y0, x1, y1].every(Number.isFinite) && x0 < x1 && y0 < y1 ? { x0, y0, x1, y1 } : null;
}

function shifted({ x0, y0, x1, y1 }: Bounds, sign: 1 | -1): Bounds {
  const [x, y] = (store.history.value?.origin ?? [0, 0]).map((each) => sign * each);
  return { x0: x0 + x, y0: y0 + y, x1: x1 + x, y1: y1 + y };
}

export function applyAddress(hash: string) {
  const found = readAddress(hash);
  batch(() => {
    store.selection.value = found.selection;
    if (found.panel !== undefined) store.panel.value = found.panel;
    store.compareWith.value = found.compareWith;
    store.beside.value = found.beside;
    store.otherEps.value = found.eps;
    store.otherMinSamples.value = found.minSamples;
    store.compareMode.value = found.settings || found.eps !== null || found.minSamples !== null ? "settings" : "moments";
    store.asked.value = found.asked;
    store.sorted.value = found.sorted;
    store.wayFrom.value = found.wayFrom;
    store.condition.value = found.condition;
    store.layers.value = found.layers;
    showBox(found.box === null ? null : shifted(found.box, -1));
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
      if (store.beside.value) found.set("beside", "1");
    } else {
      found.set("compare", "settings");
      if (store.otherEps.value !== null) found.set("eps_m", String(store.otherEps.value));
      if (store.otherMinSamples.value !== null) found.set("min_samples", String(store.otherMinSamples.value));
    }
  }
  if (store.wayFrom.value !== null) found.set("from", store.wayFrom.value);
  const { what, room, every } = store.asked.value;
  if (what !== "") found.set("what", what);
  if (room !== "") found.set("in", room);
  if (every) found.set("once", "1");
  const { by, down } = store.sorted.value;
  if (by !== "seen" || !down) found.set("sort", (down ? "-" : "") + by);
  if (store.panel.value === "find" && store.condition.value !== "") found.set("if", store.condition.value);
  const shown = Object.entries(store.layers.value).filter(([, on]) => on).map(([name]) => name);
  if (shown.join() !== Object.entries(store.LAYERS).filter(([, on]) => on).map(([name]) => name).join()) found.set("layers", shown.join());
  void store.view.value;
  const box = viewBox();
  if (box !== null) found.set("box", Object.values(shifted(box, 1)).map((each) => String(Number(each.toFixed(3)))).join());
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
