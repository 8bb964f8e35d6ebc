/** A map in one sentence, also for people who do not see it. */

import type { History } from "../history/types";
import type { MapState } from "../model/map_at";
import { counted } from "../model/names";

export function summary(map: MapState | null, history: History | null): string {
  if (map === null || history === null) return "No map yet";
  const noise = map.noise > 0 ? `, ${counted(map.noise, "keyframe")} in no place` : "";
  return (
    `Map after ${counted(map.at, "event")}: ${counted(map.keyframeCount, "keyframe")}, ` +
    `${counted(map.places.length, "place")}, ${counted(map.objects.length, "object")}${noise}`
  );
}

/** `2026-05-04 09:03:06.000` in UTC; the robot's clock. */
export function when(stamp: number): string {
  if (!Number.isFinite(stamp) || Math.abs(stamp) > 8.6e12) return "";
  return new Date(stamp * 1000).toISOString().replace("T", " ").replace("Z", "");
}
