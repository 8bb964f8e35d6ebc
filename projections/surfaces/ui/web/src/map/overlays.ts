/** What an answer adds to the map: a difference, the bridge of a merge, where a lost robot may be. */

import { MANY } from "./dots";
import { drawArrow, dotRadius } from "./keyframes";
import { type Box, FONT, overlap } from "./labels";
import { withAlpha } from "./palette";
import type { Bridge, Scene } from "./scene";
import type { Surface } from "./surface";
import { screenX, screenY } from "./view";

const ROUND = 2 * Math.PI;

export function drawDifference(on: Surface, scene: Scene) {
  if (scene.difference === null) return;
  const { before, difference } = scene.difference;
  const { history, view, palette } = scene;
  const { x, y } = history.keyframes;
  const radius = dotRadius(view.k) + 2;
  const circles = (keyframes: number[], colour: string, width: number) => {
    on.beginPath();
    for (const each of keyframes) {
      const [sx, sy] = [screenX(view, x[each]), screenY(view, y[each])];
      if (Number.isNaN(sx)) continue;
      if (keyframes.length >= MANY) {
        on.rect(sx - 1, sy - 1, 2, 2); // rings would cover the map
        continue;
      }
      on.moveTo(sx + radius, sy);
      on.arc(sx, sy, radius, 0, ROUND);
    }
    on.strokeStyle = on.fillStyle = colour;
    on.lineWidth = width;
    if (keyframes.length >= MANY) on.fill();
    else on.stroke();
  };
  circles(difference.movedKeyframes, palette.moved, 1.6);
  circles(difference.newKeyframes, palette.added, 1.4);
  for (const { x0, y0, x1, y1 } of difference.shifts) arrow(on, scene, x0, y0, x1, y1);
  for (const [object, change] of difference.objects) {
    if (change === "changed" || change === "joined") continue;
    const row = change === "gone" ? before.objectRow[object] : scene.map.objectRow[object];
    const shown = row >= 0 ? row : before.objectRow[object];
    if (shown < 0) continue;
    if (history.changes.confirmed[shown] === 0 && !scene.layers.once) continue;
    const colour = { new: palette.added, gone: palette.removed, moved: palette.moved }[change];
    badge(on, screenX(view, history.changes.x[shown]), screenY(view, history.changes.y[shown]), colour, change);
  }
}

function badge(on: Surface, x: number, y: number, colour: string, change: string) {
  on.strokeStyle = colour;
  on.lineWidth = 1.8;
  on.beginPath();
  if (change === "gone") {
    on.moveTo(x - 6, y - 6);
    on.lineTo(x + 6, y + 6);
    on.moveTo(x + 6, y - 6);
    on.lineTo(x - 6, y + 6);
  } else {
    on.rect(x - 7, y - 7, 14, 14);
  }
  on.stroke();
}

export function arrow(on: Surface, scene: Scene, x0: number, y0: number, x1: number, y1: number) {
  const { view, palette } = scene;
  const [ax, ay, bx, by] = [screenX(view, x0), screenY(view, y0), screenX(view, x1), screenY(view, y1)];
  if (Math.hypot(bx - ax, by - ay) < 6) return;
  const angle = Math.atan2(by - ay, bx - ax);
  on.beginPath();
  on.moveTo(ax, ay);
  on.lineTo(bx, by);
  for (const turn of [2.6, -2.6]) {
    on.moveTo(bx, by);
    on.lineTo(bx + Math.cos(angle + turn) * 7, by + Math.sin(angle + turn) * 7);
  }
  on.strokeStyle = palette.moved;
  on.lineWidth = 1.6;
  on.stroke();
}

export function drawBridge(on: Surface, scene: Scene, bridge: Bridge) {
  const { view, palette, history } = scene;
  on.beginPath();
  for (const keyframe of bridge.core) {
    const [x, y] = [screenX(view, history.keyframes.x[keyframe]), screenY(view, history.keyframes.y[keyframe])];
    on.moveTo(x + dotRadius(view.k) + 1.5, y);
    on.arc(x, y, dotRadius(view.k) + 1.5, 0, ROUND);
  }
  on.strokeStyle = withAlpha(palette.ink, 0.7);
  on.lineWidth = 1;
  on.stroke();
  for (const { points, distances } of bridge.chains) {
    const at = points.map(({ x, y }) => [screenX(view, x), screenY(view, y)] as const);
    on.lineWidth = 1.2;
    on.setLineDash([4, 4]);
    points.forEach((point, index) => {
      on.beginPath();
      on.arc(at[index][0], at[index][1], bridge.epsM * view.k, 0, ROUND);
      on.fillStyle = withAlpha(palette.accent, point.madeCore ? 0.1 : 0.03);
      on.fill();
      on.strokeStyle = withAlpha(palette.accent, point.madeCore ? 0.8 : 0.35);
      on.stroke();
    });
    on.setLineDash([]);
    on.beginPath();
    at.forEach(([x, y], index) => (index === 0 ? on.moveTo(x, y) : on.lineTo(x, y)));
    on.strokeStyle = palette.ink;
    on.lineWidth = 2.4;
    on.stroke();
    points.forEach((point, index) => {
      on.beginPath();
      on.arc(at[index][0], at[index][1], 5, 0, ROUND);
      on.fillStyle = point.madeCore ? palette.accent : palette.ink;
      on.fill();
      on.strokeStyle = palette.ground;
      on.lineWidth = 1.5;
      on.stroke();
    });
    writeDistances(on, scene, at, distances);
  }
}

/** Beside the middle of each step, if the step is long enough on the screen for it. */
function writeDistances(on: Surface, scene: Scene, at: (readonly [number, number])[], distances: number[]) {
  distances.forEach((metres, index) => {
    const [[ax, ay], [bx, by]] = [at[index], at[index + 1]];
    const length = Math.hypot(bx - ax, by - ay);
    if (length < 26) return;
    const [nx, ny] = [-(by - ay) / length, (bx - ax) / length];
    const side = ny > 0 ? -1 : 1;
    text(on, scene, (ax + bx) / 2 + side * nx * 24, (ay + by) / 2 + side * ny * 12, `${metres.toFixed(2)} m`, scene.palette.ink);
  });
}

/** The heat map of where the robot may be, below everything with a name. */
export function drawLikely(on: Surface, scene: Scene) {
  const { lost, view, palette } = scene;
  if (lost === null) return;
  const most = Math.max(1e-12, ...lost.cells.map((cell) => cell.share));
  for (const { x, y, size, share } of lost.cells) {
    const side = Math.max(2, size * view.k);
    on.beginPath();
    on.rect(screenX(view, x) - side / 2, screenY(view, y) - side / 2, side, side);
    on.fillStyle = withAlpha(palette.accent, 0.06 + 0.74 * Math.sqrt(share / most));
    on.fill();
  }
}

export function drawWay(on: Surface, { way, view, palette }: Scene) {
  if (way === null) return;
  on.beginPath();
  way.points.forEach(([x, y], index) => (index === 0 ? on.moveTo(screenX(view, x), screenY(view, y)) : on.lineTo(screenX(view, x), screenY(view, y))));
  for (const [colour, width] of [[palette.ground, 7], [palette.accent, 3.5]] as const) {
    on.strokeStyle = colour;
    on.lineWidth = width;
    on.stroke();
  }
  const spots = [...way.doors, ...way.points.slice(0, 1), ...(way.goal === null ? way.points.slice(-1) : [])];
  for (const [x, y] of spots) {
    on.beginPath();
    on.arc(screenX(view, x), screenY(view, y), 5, 0, ROUND);
    on.fillStyle = palette.ground;
    on.fill();
    on.strokeStyle = palette.accent;
    on.lineWidth = 2.2;
    on.stroke();
  }
  if (way.goal !== null) drawArrow(on, screenX(view, way.goal.x), screenY(view, way.goal.y), way.goal.yaw, 13, palette.accent, palette.ground);
}

export function drawLost(on: Surface, scene: Scene) {
  const { lost, view, palette } = scene;
  if (lost === null) return;
  const { pose, truth, others } = lost;
  const taken: Box[] = [];
  if (pose !== null) {
    const [px, py] = [screenX(view, pose.x), screenY(view, pose.y)];
    for (const { x, y, text: says, place } of lost.evidence) {
      const [ex, ey] = [screenX(view, x), screenY(view, y)];
      if (place >= 0) {
        on.beginPath();
        on.moveTo(ex, ey);
        on.lineTo(screenX(view, scene.map.x[place]), screenY(view, scene.map.y[place]));
        on.strokeStyle = withAlpha(palette.accent, 0.5);
        on.lineWidth = 1.2;
        on.setLineDash([5, 4]);
        on.stroke();
        on.setLineDash([]);
      }
      on.beginPath();
      on.moveTo(px, py);
      on.lineTo(ex, ey);
      on.strokeStyle = withAlpha(palette.ink, 0.65);
      on.lineWidth = 1.4;
      on.stroke();
      text(on, scene, ex, ey - 14, says, palette.ink, taken);
    }
    on.beginPath();
    on.arc(px, py, Math.max(9, pose.spread * view.k), 0, ROUND);
    on.strokeStyle = palette.accent;
    on.lineWidth = 1.6;
    on.stroke();
    if (pose.yaw !== null) drawArrow(on, px, py, pose.yaw, 13, palette.accent, palette.ground);
    text(on, scene, px, py + 24, "answer", palette.accent, taken);
  }
  for (const { x, y, share } of others) {
    const [ox, oy] = [screenX(view, x), screenY(view, y)];
    on.beginPath();
    on.arc(ox, oy, 9, 0, ROUND);
    on.strokeStyle = palette.accent;
    on.lineWidth = 1.4;
    on.setLineDash([3, 3]);
    on.stroke();
    on.setLineDash([]);
    text(on, scene, ox, oy + 19, `or here ${Math.round(100 * share)} %`, palette.accent, taken);
  }
  if (truth !== null) {
    const [tx, ty] = [screenX(view, truth.x), screenY(view, truth.y)];
    if (truth.yaw !== null) drawArrow(on, tx, ty, truth.yaw, 12, palette.added, palette.ground);
    text(on, scene, tx, ty - 22, "true pose", palette.added, taken);
  }
}

/** Writes about (x, y), further up where one of `taken` is in the way. */
function text(on: Surface, scene: Scene, x: number, wanted: number, says: string, colour: string, taken: Box[] = []) {
  on.font = `600 11px ${FONT}`;
  const width = on.measureText(says).width + 6;
  const at = (y: number) => ({ x: x - width / 2, y: y - 8, width, height: 16 });
  let y = wanted;
  while (taken.some((box) => overlap(box, at(y))) && y > wanted - 120) y -= 15;
  taken.push(at(y));
  on.textAlign = "center";
  on.textBaseline = "middle";
  on.strokeStyle = scene.palette.halo;
  on.lineWidth = 3.5;
  on.lineJoin = "round";
  on.strokeText(says, x, y);
  on.fillStyle = colour;
  on.fillText(says, x, y);
}
