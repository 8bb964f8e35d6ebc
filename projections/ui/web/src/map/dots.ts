/**
 * Many keyframes as pixels: their paths and dots written into a buffer, which is then drawn as one
 * picture. Without a graphics card this takes a tenth of the time of drawing each on the canvas.
 */

import type { History } from "../history/types";
import type { MapState } from "../model/map_at";
import { type Palette, placeColour, rgb } from "./palette";
import type { View } from "./view";

/** From how many keyframes on they are drawn so. */
export const MANY = 2500;
const SUBPIXELS = 4;

export class DotLayer {
  private readonly canvas = document.createElement("canvas");
  private image: ImageData | null = null;

  /** A canvas of the size of the map's, in device pixels. */
  draw(history: History, map: MapState, view: View, palette: Palette, width: number, height: number, ratio: number, radius: number): HTMLCanvasElement {
    if (this.image === null || this.image.width !== width || this.image.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
      this.image = new ImageData(width, height);
    }
    const pixels = new Uint32Array(this.image.data.buffer);
    pixels.fill(0);
    const [k, x, y] = [view.k * ratio, view.x * ratio, view.y * ratio];
    const screen = { k, x, y, width, height };
    drawPaths(pixels, history, map, screen, packed(palette.faint, 150));
    drawDots(pixels, history, map, screen, palette, radius * ratio);
    const context = this.canvas.getContext("2d") as CanvasRenderingContext2D;
    context.putImageData(this.image, 0, 0);
    return this.canvas;
  }
}

interface Screen {
  k: number;
  x: number;
  y: number;
  width: number;
  height: number;
}

function packed(colour: string, alpha: number): number {
  const [r, g, b] = rgb(colour);
  return ((alpha << 24) | (b << 16) | (g << 8) | r) >>> 0;
}

function drawPaths(pixels: Uint32Array, history: History, map: MapState, screen: Screen, colour: number) {
  const { x: xs, y: ys, run } = history.keyframes;
  const { k, width, height } = screen;
  const last = new Map<number, number>();
  for (let each = 0; each < map.keyframeCount; each++) {
    if (xs[each] !== xs[each]) continue;
    const before = last.get(run[each]);
    last.set(run[each], each);
    if (before === undefined) continue;
    const [x0, y0] = [xs[before] * k + screen.x, screen.y - ys[before] * k];
    const [x1, y1] = [xs[each] * k + screen.x, screen.y - ys[each] * k];
    if (Math.max(x0, x1) < 0 || Math.min(x0, x1) > width) continue;
    if (Math.max(y0, y1) < 0 || Math.min(y0, y1) > height) continue;
    const steps = Math.ceil(Math.max(Math.abs(x1 - x0), Math.abs(y1 - y0)));
    if (steps > 4 * (width + height)) continue;
    for (let step = 0; step <= steps; step++) {
      const share = steps === 0 ? 0 : step / steps;
      const [px, py] = [(x0 + (x1 - x0) * share) | 0, (y0 + (y1 - y0) * share) | 0];
      if (px >= 0 && py >= 0 && px < width && py < height) pixels[py * width + px] = colour;
    }
  }
}

function drawDots(pixels: Uint32Array, history: History, map: MapState, screen: Screen, palette: Palette, radius: number) {
  const { x: xs, y: ys } = history.keyframes;
  const { k, width, height } = screen;
  const masks = discs(radius);
  const edge = Math.ceil(radius) + 1;
  const colours = new Map<number, number>();
  for (let each = 0; each < map.keyframeCount; each++) {
    const [x, y] = [xs[each] * k + screen.x, screen.y - ys[each] * k];
    if (!(x > edge && y > edge && x < width - edge && y < height - edge)) continue; // NaN too
    const place = map.placeOf[each];
    let colour = colours.get(place);
    if (colour === undefined) {
      colour = packed(placeColour(palette, history, place), 0);
      colours.set(place, colour);
    }
    const [left, top] = [x | 0, y | 0];
    const mask = masks[(((y - top) * SUBPIXELS) | 0) * SUBPIXELS + (((x - left) * SUBPIXELS) | 0)];
    const base = top * width + left;
    for (let i = 0; i < mask.length; i += 3) {
      const pixel = base + mask[i + 1] * width + mask[i];
      const alpha = mask[i + 2];
      if (alpha >= pixels[pixel] >>> 24) pixels[pixel] = (colour | (alpha << 24)) >>> 0;
    }
  }
}

/** By position within a pixel, the pixels of a disc around it: dx, dy, coverage. */
function discs(radius: number): Int32Array[] {
  const found: Int32Array[] = [];
  const reach = Math.ceil(radius) + 1;
  for (let sy = 0; sy < SUBPIXELS; sy++) {
    for (let sx = 0; sx < SUBPIXELS; sx++) {
      const mask: number[] = [];
      const [cx, cy] = [(sx + 0.5) / SUBPIXELS, (sy + 0.5) / SUBPIXELS];
      for (let dy = -reach; dy <= reach; dy++) {
        for (let dx = -reach; dx <= reach; dx++) {
          const distance = Math.hypot(dx + 0.5 - cx, dy + 0.5 - cy);
          const cover = Math.max(0, Math.min(1, radius + 0.5 - distance));
          if (cover > 0.03) mask.push(dx, dy, Math.round(cover * 255));
        }
      }
      found.push(Int32Array.from(mask));
    }
  }
  return found;
}
