/** What panels' answers draw on the map. */

import { computed, signal } from "@preact/signals";
import type { Bridge, LostOverlay, WayOverlay } from "../map/scene";
import type { MapChange } from "../api/types";
import { compareMoments } from "../model/compare";
import { findObject } from "../model/names";
import { comparedMap, history, map, panel } from "./store";

/** Of the selected merge. */
export const bridge = signal<Bridge | null>(null);
/** Where on the map a question was just asked from, metres. */
export const lostPoint = signal<{ x: number; y: number } | null>(null);
export const lostOverlay = signal<LostOverlay | null>(null);

/** To what is selected. */
export const way = signal<WayOverlay | null>(null);

/** What changed between the two moments compared; null where that is not known. */
export const sureChanges = signal<readonly MapChange[] | null>(null);
const DRAWN = { moved: "moved", missing: "gone", new: "new", back: "new" } as const;

export const difference = computed(() => {
  const [before, after, of] = [comparedMap.value, map.value, history.value];
  if (before === null || after === null || of === null) return null;
  const found = compareMoments(of, before, after);
  if (sureChanges.value === null) return { before, difference: found };
  const objects = new Map(sureChanges.value.map(({ object_id, kind }) => [findObject(of, object_id), DRAWN[kind]]));
  const shifts = found.shifts.filter(({ object }) => objects.get(object) === "moved");
  return { before, difference: { ...found, objects, shifts } };
});

export const shownBridge = computed(() => (panel.value === "why" ? bridge.value : null));
export const shownWay = computed(() => (panel.value === "why" ? way.value : null));
export const shownLost = computed(() => (panel.value === "lost" ? lostOverlay.value : null));
