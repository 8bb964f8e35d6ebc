/** What panels' answers draw on the map. */

import { computed, signal } from "@preact/signals";
import type { Bridge, LostOverlay } from "../map/scene";
import { compareMoments } from "../model/compare";
import { comparedMap, history, map, panel } from "./store";

/** Of the selected merge. */
export const bridge = signal<Bridge | null>(null);
export const lostOverlay = signal<LostOverlay | null>(null);

export const difference = computed(() => {
  const [before, after] = [comparedMap.value, map.value];
  if (before === null || after === null || history.value === null) return null;
  return { before, difference: compareMoments(history.value, before, after) };
});

export const shownBridge = computed(() => (panel.value === "why" ? bridge.value : null));
export const shownLost = computed(() => (panel.value === "lost" ? lostOverlay.value : null));
