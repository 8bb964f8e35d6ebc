/** Objects with the ellipses of where they stand, and lines between adjacent places. */

import { litObject } from "./lit";
import { withAlpha } from "./palette";
import { NEAR } from "./view";
import type { Scene } from "./scene";
import type { Surface } from "./surface";
import { screenX, screenY } from "./view";

/** An ellipse that holds the object with a probability of 0.95. */
const SIGMAS = 2.4477;

export function drawEdges(on: Surface, scene: Scene) {
  const { map, view, palette } = scene;
  for (const { a, b, count } of map.edges) {
    on.beginPath();
    on.moveTo(screenX(view, map.x[a]), screenY(view, map.y[a]));
    on.lineTo(screenX(view, map.x[b]), screenY(view, map.y[b]));
    on.strokeStyle = withAlpha(palette.ink, 0.28);
    on.lineWidth = Math.min(5, 1 + Math.log2(1 + count) / 2);
    on.setLineDash([1, 4]);
    on.lineCap = "round";
    on.stroke();
    on.setLineDash([]);
    on.lineCap = "butt";
  }
}

export function objectRadius(k: number): number {
  return Math.max(2.2, Math.min(5, k * 0.055));
}

export function drawObjects(on: Surface, scene: Scene) {
  const { history, map, view, palette, width, height } = scene;
  const { x: xs, y: ys, xx, missing, confirmed } = history.changes;
  const size = objectRadius(view.k);
  const [selected, hovered] = [litObject(scene, scene.selection), litObject(scene, scene.hovered)];
  for (const object of map.objects) {
    const row = map.objectRow[object];
    const lit = object === selected || object === hovered || scene.found.has(object);
    if (!lit && !scene.layers.once && confirmed[row] === 0) continue;
    const [x, y] = [screenX(view, xs[row]), screenY(view, ys[row])];
    if (!(x > -50 && y > -50 && x < width + 50 && y < height + 50)) continue;
    if (scene.layers.ellipses && (lit || view.k >= NEAR) && !Number.isNaN(xx[row])) drawEllipse(on, scene, row, x, y, lit);
    on.beginPath(); // a diamond: dots are keyframes
    on.moveTo(x, y - size * 1.25);
    on.lineTo(x + size * 1.25, y);
    on.lineTo(x, y + size * 1.25);
    on.lineTo(x - size * 1.25, y);
    on.closePath();
    on.lineWidth = 1.3;
    if (missing[row]) {
      on.fillStyle = palette.ground;
      on.strokeStyle = palette.removed;
    } else {
      on.fillStyle = lit ? palette.accent : withAlpha(palette.object, confirmed[row] === 1 ? 1 : 0.4);
      on.strokeStyle = palette.ground;
    }
    on.fill();
    on.stroke();
    if (lit) {
      on.beginPath();
      on.arc(x, y, size + 6, 0, 2 * Math.PI);
      on.strokeStyle = palette.accent;
      on.lineWidth = object === selected ? 2.4 : 1.4;
      on.stroke();
    }
  }
}

function drawEllipse(on: Surface, scene: Scene, row: number, x: number, y: number, lit: boolean) {
  const { xx, xy, yy } = scene.history.changes;
  const half = (xx[row] + yy[row]) / 2;
  const spread = Math.hypot((xx[row] - yy[row]) / 2, xy[row]);
  const [long, wide] = [Math.sqrt(half + spread), Math.sqrt(Math.max(0, half - spread))];
  const turn = Math.atan2(2 * xy[row], xx[row] - yy[row]) / 2;
  const k = scene.view.k * SIGMAS;
  on.beginPath();
  on.ellipse(x, y, Math.min(long * k, 4000), Math.min(wide * k, 4000), -turn, 0, 2 * Math.PI);
  if (lit) {
    on.fillStyle = withAlpha(scene.palette.object, 0.12);
    on.fill();
  }
  on.strokeStyle = withAlpha(scene.palette.object, lit ? 0.8 : 0.16);
  on.lineWidth = 1;
  on.stroke();
}
