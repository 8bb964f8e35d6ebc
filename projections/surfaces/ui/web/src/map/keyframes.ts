/** The robot's drive: its path, its keyframes in the colours of their places, and where it is. */

import { MANY } from "./dots";
import { litKeyframe } from "./lit";
import { placeColour, withAlpha } from "./palette";
import type { Scene } from "./scene";
import type { Surface } from "./surface";
import { screenX, screenY } from "./view";

export function dotRadius(k: number): number {
  return Math.max(1.3, Math.min(4.5, k * 0.05));
}

export function drawKeyframes(on: Surface, scene: Scene) {
  if (scene.dots !== null && scene.map.keyframeCount >= MANY) {
    scene.dots();
  } else {
    if (scene.layers.path) drawPath(on, scene);
    if (scene.layers.keyframes) drawDots(on, scene);
  }
  for (const thing of [scene.hovered, scene.selection]) {
    const keyframe = litKeyframe(scene, thing);
    if (keyframe >= 0) ring(on, scene, keyframe, thing === scene.selection);
  }
}

function drawPath(on: Surface, scene: Scene) {
  const { history, map, view, palette } = scene;
  const { x: xs, y: ys, run } = history.keyframes;
  const last = new Map<number, number>();
  on.beginPath();
  for (let each = 0; each < map.keyframeCount; each++) {
    if (xs[each] !== xs[each]) continue;
    const before = last.get(run[each]);
    last.set(run[each], each);
    if (before === undefined) continue;
    on.moveTo(screenX(view, xs[before]), screenY(view, ys[before]));
    on.lineTo(screenX(view, xs[each]), screenY(view, ys[each]));
  }
  on.strokeStyle = palette.faint;
  on.lineWidth = 1;
  on.stroke();
}

function drawDots(on: Surface, scene: Scene) {
  const { history, map, view, palette, width, height } = scene;
  const { x: xs, y: ys } = history.keyframes;
  const radius = dotRadius(view.k);
  const byPlace = new Map<number, number[]>();
  for (let each = 0; each < map.keyframeCount; each++) {
    const [x, y] = [screenX(view, xs[each]), screenY(view, ys[each])];
    if (!(x > -9 && y > -9 && x < width + 9 && y < height + 9)) continue;
    const group = byPlace.get(map.placeOf[each]);
    if (group === undefined) byPlace.set(map.placeOf[each], [x, y]);
    else group.push(x, y);
  }
  for (const [place, spots] of byPlace) {
    on.beginPath();
    for (let i = 0; i < spots.length; i += 2) {
      on.moveTo(spots[i] + radius, spots[i + 1]);
      on.arc(spots[i], spots[i + 1], radius, 0, 2 * Math.PI);
    }
    if (place < 0) {
      on.strokeStyle = palette.noise;
      on.lineWidth = 1.2;
      on.stroke();
    } else {
      on.fillStyle = placeColour(palette, history, place);
      on.fill();
    }
  }
}

function ring(on: Surface, scene: Scene, keyframe: number, selected: boolean) {
  const { x, y, yaw } = scene.history.keyframes;
  if (Number.isNaN(x[keyframe])) return;
  const [sx, sy] = [screenX(scene.view, x[keyframe]), screenY(scene.view, y[keyframe])];
  on.beginPath();
  on.arc(sx, sy, dotRadius(scene.view.k) + 4, 0, 2 * Math.PI);
  on.strokeStyle = scene.palette.accent;
  on.lineWidth = selected ? 2.4 : 1.4;
  on.stroke();
  if (selected) heading(on, sx, sy, yaw[keyframe], 20, scene.palette.accent);
}

/** The last keyframe with a pose; -1 where that is on another floor. */
export function robotAt({ history, map }: Scene): number {
  const { x, yaw } = history.keyframes;
  let last = map.keyframeCount - 1;
  while (last >= 0 && Number.isNaN(yaw[last])) last--;
  return last < 0 || Number.isNaN(x[last]) ? -1 : last;
}

/** A filled arrow that points where the robot looks. */
export function drawRobot(on: Surface, scene: Scene) {
  const { x, y, yaw } = scene.history.keyframes;
  const last = robotAt(scene);
  if (last < 0) return;
  drawArrow(on, screenX(scene.view, x[last]), screenY(scene.view, y[last]), yaw[last], 11, scene.palette.ink, scene.palette.ground);
}

export function drawArrow(on: Surface, x: number, y: number, yaw: number, size: number, fill: string, edge: string) {
  const at = (angle: number, length: number): [number, number] => [
    x + Math.cos(yaw + angle) * length,
    y - Math.sin(yaw + angle) * length,
  ];
  on.beginPath();
  on.moveTo(...at(0, size));
  on.lineTo(...at(2.5, size * 0.85));
  on.lineTo(...at(Math.PI, size * 0.35));
  on.lineTo(...at(-2.5, size * 0.85));
  on.closePath();
  on.fillStyle = fill;
  on.fill();
  on.strokeStyle = edge;
  on.lineWidth = 1.5;
  on.lineJoin = "round";
  on.stroke();
}

function heading(on: Surface, x: number, y: number, yaw: number, length: number, colour: string) {
  on.beginPath();
  on.moveTo(x, y);
  on.lineTo(x + Math.cos(yaw) * length, y - Math.sin(yaw) * length);
  on.strokeStyle = withAlpha(colour, 0.9);
  on.lineWidth = 2;
  on.stroke();
}
