/** From metres to pixels of the canvas and back; y points up in the map and down on the screen. */

import type { Bounds } from "../model/regions";

/** `k` is pixels to a metre; (x, y) is where the map's origin is on the screen. */
export interface View {
  k: number;
  x: number;
  y: number;
}

/** Pixels to a metre from which there is room for more than the names of places. */
export const NEAR = 18;

export const screenX = (view: View, x: number) => x * view.k + view.x;
export const screenY = (view: View, y: number) => view.y - y * view.k;
export const mapX = (view: View, x: number) => (x - view.x) / view.k;
export const mapY = (view: View, y: number) => (view.y - y) / view.k;

/** The view in which the bounds fill a canvas, leaving margins in pixels. */
export function fitted(bounds: Bounds, width: number, height: number, margin = 40, top = 26): View {
  const w = Math.max(bounds.x1 - bounds.x0, 0.5) + 1.2;
  const h = Math.max(bounds.y1 - bounds.y0, 0.5) + 1.2;
  const k = Math.max(1e-3, Math.min((width - 2 * margin) / w, (height - top - 2 * margin) / h));
  return {
    k,
    x: width / 2 - (k * (bounds.x0 + bounds.x1)) / 2,
    y: (height + top) / 2 + (k * (bounds.y0 + bounds.y1)) / 2,
  };
}

/** A round length in metres whose bar is about as wide as asked. */
export function scaleBar(view: View, about: number): { metres: number; width: number } {
  const wanted = about / view.k;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const metres = [5, 2, 1].map((digit) => digit * power).find((length) => length <= wanted) ?? power;
  return { metres, width: metres * view.k };
}
