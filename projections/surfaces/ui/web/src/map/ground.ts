/** The lower layers of the map: the grid of metres, regions of places, walls. */

import { outlinesOf } from "../model/walls";
import { isPlaceLit } from "./lit";
import { placeColour, withAlpha } from "./palette";
import type { Scene } from "./scene";
import type { Surface } from "./surface";
import { mapX, mapY, screenX, screenY } from "./view";

const LEAST_PIXELS = 28;

export function drawGrid(on: Surface, scene: Scene) {
  const { view, width, height, palette } = scene;
  let step = 1;
  while (step * view.k < LEAST_PIXELS) step *= step.toString().startsWith("2") ? 2.5 : 2;
  const [x0, x1] = [Math.floor(mapX(view, 0) / step), Math.ceil(mapX(view, width) / step)];
  const [y0, y1] = [Math.floor(mapY(view, height) / step), Math.ceil(mapY(view, 0) / step)];
  on.beginPath();
  for (let x = x0; x <= x1; x++) {
    const at = Math.round(screenX(view, x * step)) + 0.5;
    on.moveTo(at, 0);
    on.lineTo(at, height);
  }
  for (let y = y0; y <= y1; y++) {
    const at = Math.round(screenY(view, y * step)) + 0.5;
    on.moveTo(0, at);
    on.lineTo(width, at);
  }
  on.strokeStyle = palette.grid;
  on.lineWidth = 1;
  on.stroke();
}

export function drawRegions(on: Surface, scene: Scene) {
  const { view, palette, regions } = scene;
  if (regions === null) return;
  for (const { place, loops } of regions.regions) {
    const colour = placeColour(palette, scene.history, place);
    const lit = isPlaceLit(scene, place);
    on.beginPath();
    for (const loop of loops) {
      for (let i = 0; i < loop.length; i += 2) {
        const [x, y] = [screenX(view, loop[i]), screenY(view, loop[i + 1])];
        if (i === 0) on.moveTo(x, y);
        else on.lineTo(x, y);
      }
      on.closePath();
    }
    on.fillStyle = withAlpha(colour, lit ? 0.3 : palette.dark ? 0.17 : 0.15);
    on.fill();
    on.strokeStyle = lit ? colour : withAlpha(colour, 0.55);
    on.lineWidth = lit ? 2.2 : 1;
    on.lineJoin = "round";
    on.stroke();
  }
}

export function drawWalls(on: Surface, scene: Scene) {
  const { view, palette, walls } = scene;
  on.beginPath();
  for (const outline of outlinesOf(walls)) {
    on.moveTo(screenX(view, outline[0]), screenY(view, outline[1]));
    for (let i = 2; i < outline.length; i += 2) on.lineTo(screenX(view, outline[i]), screenY(view, outline[i + 1]));
    on.closePath();
  }
  on.fillStyle = on.strokeStyle = palette.wall;
  on.fill("evenodd");
  on.lineWidth = 1; // so that thin walls are seen from afar
  on.stroke();
}
