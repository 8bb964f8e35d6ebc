/** The scene of one of the two maps as things are now. */

import { difference, shownBridge, shownLost } from "../state/overlays";
import * as store from "../state/store";
import { DARK, LIGHT } from "./palette";
import type { Scene } from "./scene";

export type Side = "main" | "other";

export function currentScene(side: Side, width: number, height: number): Scene | null {
  const main = side === "main";
  const history = main ? store.history.value : store.otherHistory.value;
  const map = main ? store.map.value : store.otherMap.value;
  const view = store.view.value;
  if (history === null || map === null || view === null) return null;
  return {
    history,
    map,
    regions: main ? store.regions.value : store.otherRegions.value,
    view,
    palette: store.dark.value ? DARK : LIGHT,
    width,
    height,
    layers: store.layers.value,
    walls: store.log.value?.walls ?? [],
    selection: store.selection.value,
    hovered: store.hovered.value,
    difference: main ? difference.value : null,
    bridge: main ? shownBridge.value : null,
    lost: main ? shownLost.value : null,
    dots: null,
  };
}
