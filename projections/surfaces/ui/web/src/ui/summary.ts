/** `142 objects + 695 seen once`. */
export function objectsText(history: History, map: MapState): string {
  const confirmed = shownObjects(history, map, false).length;
  const once = map.objects.length - confirmed;
  return counted(confirmed, "object") + (once > 0 ? ` + ${once.toLocaleString("en")} seen once` : "");
}

/** A map in one sentence, also for people who do not see it. */

import type { History } from "../history/types";
import { type MapState, shownObjects } from "../model/map_at";
import { counted } from "../model/names";

export function summary(map: MapState | null, history: History | null): string {
  if (map === null || history === null) return "No map yet";
  const noise = map.noise > 0 ? `, ${counted(map.noise, "keyframe")} in no place` : "";
  return (
    `Map after ${counted(map.at, "event")}: ${counted(map.keyframeCount, "keyframe")}, ` +
    `${counted(map.places.length, "place")}, ${objectsText(history, map)}${noise}`
  );
}

/** `2026-05-04 09:03:06.000` in UTC; the robot's clock. */
export function when(stamp: number): string {
  if (!Number.isFinite(stamp) || Math.abs(stamp) > 8.6e12) return "";
  return new Date(stamp * 1000).toISOString().replace("T", " ").replace("Z", "");
}
