/** The scene of one of the two maps as things are now. */

import { difference, shownBridge, shownLost, shownWay } from "../state/overlays";
import { differenceOn } from "../model/floors";
import { dragged } from "../panels/drag_edits";
import { walls } from "../state/walls";
import * as store from "../state/store";
import { litObject } from "./lit";
import { DARK, LIGHT } from "./palette";
import type { Scene } from "./scene";

export type Side = "main" | "other";

export function currentScene(side: Side, width: number, height: number): Scene | null {
  const main = side === "main";
  const shown = main ? store.shown.value : store.otherShown.value;
  const view = store.view.value;
  if (shown === null || view === null) return null;
  const { history } = shown;
  const floor = store.shownFloor.value;
  const compared = main ? difference.value : null;
  return {
    ...shown,
    regions: main ? store.regions.value : store.otherRegions.value,
    view,
    palette: store.dark.value ? DARK : LIGHT,
    width,
    height,
    layers: store.layers.value,
    walls: walls.value,
    types: main ? store.rooms.value : store.compareMode.value === "moments" ? new Map(store.otherFacts.value?.rooms.map((each) => [each.place_id, each])) : new Map(),
    selection: store.selection.value,
    hovered: store.hovered.value,
    found: new Set(store.found.value.map((thing) => litObject(shown, thing))),
    difference: compared === null ? null : { ...compared, difference: differenceOn(history, compared.difference, floor) },
    bridge: main ? shownBridge.value : null,
    way: main ? shownWay.value : null,
    lost: main ? shownLost.value : null,
    drag: main ? dragged.value : null,
    controls: [],
    dots: null,
  };
}
