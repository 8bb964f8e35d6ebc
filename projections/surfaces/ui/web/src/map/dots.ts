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
/** Of how many keyframes at most the path is drawn, the last ones: more cover each other. */
const MOST_PATH = 20_000;
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

const previous = new WeakMap<History, Int32Array>();

/** By keyframe the one with a pose before it in its run, or -1. */
function previousOf(history: History): Int32Array {
  let found = previous.get(history);
  if (found === undefined) {
    const { x, run } = history.keyframes;
    const last = new Int32Array(history.runIds.length).fill(-1);
    found = new Int32Array(x.length).fill(-1);
    for (let each = 0; each < x.length; each++) {
      if (Number.isNaN(x[each])) continue;
      found[each] = last[run[each]];
      last[run[each]] = each;
    }
    previous.set(history, found);
  }
  return found;
}

function drawPaths(pixels: Uint32Array, history: History, map: MapState, screen: Screen, colour: number) {
  const { x: xs, y: ys } = history.keyframes;
  const { k, width, height } = screen;
  const before = previousOf(history);
  for (let each = Math.max(0, map.keyframeCount - MOST_PATH); each < map.keyframeCount; each++) {
    const last = before[each];
    if (last < 0) continue;
    const x0 = xs[last] * k + screen.x;
    const y0 = screen.y - ys[last] * k;
    const dx = xs[each] * k + screen.x - x0;
    const dy = screen.y - ys[each] * k - y0;
    if (Math.max(x0, x0 + dx) < 0 || Math.min(x0, x0 + dx) > width) continue;
    if (Math.max(y0, y0 + dy) < 0 || Math.min(y0, y0 + dy) > height) continue;
    const steps = Math.ceil(Math.max(Math.abs(dx), Math.abs(dy)));
    if (steps > 4 * (width + height)) continue;
    for (let step = 0; step < steps; step++) {
      const px = (x0 + (dx * step) / steps) | 0;
      const py = (y0 + (dy * step) / steps) | 0;
      if (px >= 0 && py >= 0 && px < width && py < height) pixels[py * width + px] = colour;
    }
  }
}

function drawDots(pixels: Uint32Array, history: History, map: MapState, screen: Screen, palette: Palette, radius: number) {
  const { x: xs, y: ys } = history.keyframes;
  const { k, width, height } = screen;
  const masks = discs(radius);
  const edge = Math.ceil(radius) + 1;
  // By place, and before them that of noise.
  const colours = Uint32Array.from([-1, ...history.placeIds.keys()], (place) => packed(placeColour(palette, history, place), 0));
  for (let each = 0; each < map.keyframeCount; each++) {
    const x = xs[each] * k + screen.x;
    const y = screen.y - ys[each] * k;
    if (!(x > edge && y > edge && x < width - edge && y < height - edge)) continue; // NaN too
    const colour = colours[map.placeOf[each] + 1];
    const left = x | 0;
    const top = y | 0;
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
