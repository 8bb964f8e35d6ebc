/** What is under the pointer: the nearest object or keyframe, else the place whose region it is. */

import { quadtree, type Quadtree } from "d3-quadtree";
import type { History } from "../history/types";
import type { MapState } from "../model/map_at";
import { keyframeId } from "../model/names";
import type { Regions } from "../model/regions";
import type { Thing } from "../state/store";
import { type View, mapX, mapY } from "./view";

const REACH_PIXELS = 9;
const trees = new WeakMap<History, Quadtree<number>>();

/** All keyframes with a pose; which of them are in the map is asked when one is found. */
function treeOf(history: History): Quadtree<number> {
  let tree = trees.get(history);
  if (tree === undefined) {
    const { x, y } = history.keyframes;
    tree = quadtree<number>()
      .x((each) => x[each])
      .y((each) => y[each])
      .addAll(Array.from(x.keys()));
    trees.set(history, tree);
  }
  return tree;
}

export interface Picked {
  thing: Thing;
  /** Ordinal of the place, object or keyframe. */
  number: number;
}

export function pick(history: History, map: MapState, regions: Regions | null, view: View, sx: number, sy: number, objects: readonly number[]): Picked | null {
  const [x, y, reach] = [mapX(view, sx), mapY(view, sy), REACH_PIXELS / view.k];
  const object = nearestObject(history, map, objects, x, y, reach);
  if (object >= 0) return { thing: { kind: "object", id: history.objectIds[object] }, number: object };
  const keyframe = nearestKeyframe(history, map, x, y, reach);
  if (keyframe >= 0) return { thing: { kind: "keyframe", id: keyframeId(history, keyframe) }, number: keyframe };
  const place = regions?.placeAt(x, y) ?? -1;
  return place < 0 ? null : { thing: { kind: "place", id: history.placeIds[place] }, number: place };
}

function nearestObject(history: History, map: MapState, objects: readonly number[], x: number, y: number, reach: number): number {
  const { x: xs, y: ys } = history.changes;
  let [found, best] = [-1, reach];
  for (const object of objects) {
    const row = map.objectRow[object];
    const distance = Math.hypot(xs[row] - x, ys[row] - y);
    if (distance < best) [found, best] = [object, distance];
  }
  return found;
}

function nearestKeyframe(history: History, map: MapState, x: number, y: number, reach: number): number {
  const { x: xs, y: ys } = history.keyframes;
  let [found, best] = [-1, reach];
  treeOf(history).visit((node, x0, y0, x1, y1) => {
    if (x0 > x + best || x1 < x - best || y0 > y + best || y1 < y - best) return true;
    if (!Array.isArray(node)) {
      for (let leaf: typeof node | undefined = node; leaf !== undefined; leaf = leaf.next) {
        const each = leaf.data;
        if (each >= map.keyframeCount) continue;
        const distance = Math.hypot(xs[each] - x, ys[each] - y);
        if (distance < best) [found, best] = [each, distance];
      }
    }
    return false;
  });
  return found;
}
