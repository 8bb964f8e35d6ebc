/** All that a picture of a map is made of. */

import type { Room } from "../api/types";
import type { History } from "../history/types";
import type { MapDifference } from "../model/compare";
import type { MapState } from "../model/map_at";
import type { Segment } from "../model/walls";
import type { Regions } from "../model/regions";
import type { LayerName, Thing } from "../state/store";
import type { Box } from "./labels";
import type { Palette } from "./palette";
import type { View } from "./view";

/** Core points that joined two places: each within ε of the next. Positions in metres. */
export interface Bridge {
  epsM: number;
  /** Keyframes near the chain that are core points. */
  core: number[];
  chains: { points: { x: number; y: number; name: string; madeCore: boolean }[]; distances: number[] }[];
}

/** Where a lost robot may be: cells of probability, its pose, landmarks that speak for it. */
export interface LostOverlay {
  cells: { x: number; y: number; size: number; share: number }[];
  pose: { x: number; y: number; yaw: number | null; spread: number } | null;
  /** Other spots where it may be, and how likely. */
  others: { x: number; y: number; share: number }[];
  truth: { x: number; y: number; yaw: number | null } | null;
  evidence: { x: number; y: number; text: string; place: number }[];
  places: Set<number>;
}

/** A way over ground that robots drove: its points and passages, and the pose at its end. */
export interface WayOverlay {
  points: [number, number][];
  doors: [number, number][];
  goal: { x: number; y: number; yaw: number } | null;
}

export interface Scene {
  history: History;
  map: MapState;
  regions: Regions | null;
  view: View;
  palette: Palette;
  width: number;
  height: number;
  layers: Record<LayerName, boolean>;
  walls: readonly Segment[];
  /** By id of a place; empty until the server has sent them for this W. */
  types: ReadonlyMap<string, Pick<Room, "type">>;
  selection: Thing | null;
  hovered: Thing | null;
  /** Objects that the search found. */
  found: ReadonlySet<number>;
  difference: { before: MapState; difference: MapDifference } | null;
  bridge: Bridge | null;
  lost: LostOverlay | null;
  way: WayOverlay | null;
  /** A correction that is being dragged, metres. */
  drag: { x0: number; y0: number; x1: number; y1: number } | null;
  /** What lies over the map on the screen, where no label may be. */
  controls: readonly Box[];
  /** Draws many keyframes at once, on a canvas only. */
  dots: (() => void) | null;
}
