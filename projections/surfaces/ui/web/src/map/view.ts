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

/** The share of a canvas that a map fills in the direction in which it is larger. */
const FILLED = 0.95;

/** The view in which the bounds fill a canvas below `top` pixels, beside what covers `left` and `right` of it as far as there is room. */
export function fitted(bounds: Bounds, width: number, height: number, left = 0, top = 0, right = 0): View {
  const [w, h] = [Math.max(bounds.x1 - bounds.x0, 1.5), Math.max(bounds.y1 - bounds.y0, 1.5)];
  const k = Math.max(1e-3, FILLED * Math.min(width / w, (height - top) / h));
  const room = Math.max(0, FILLED * width - k * w);
  const from = Math.min(left, room);
  const to = width - Math.min(right, room - from);
  return {
    k,
    x: (from + to) / 2 - (k * (bounds.x0 + bounds.x1)) / 2,
    y: (top + height) / 2 + (k * (bounds.y0 + bounds.y1)) / 2,
  };
}

/** The view of a part of the map as large as it fits, in the middle. */
export function filled({ x0, y0, x1, y1 }: Bounds, width: number, height: number): View {
  const k = Math.min(width / (x1 - x0), height / (y1 - y0));
  return { k, x: (width - k * (x0 + x1)) / 2, y: (height + k * (y0 + y1)) / 2 };
}

/** A round length in metres whose bar is about as wide as asked. */
export function scaleBar(view: View, about: number): { metres: number; width: number } {
  const wanted = about / view.k;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const metres = [5, 2, 1].map((digit) => digit * power).find((length) => length <= wanted) ?? power;
  return { metres, width: metres * view.k };
}
