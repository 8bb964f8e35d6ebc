/**
 * Labels that do not cover each other: the most important first, each at the first free spot
 * around its anchor; one for which there is none is left out.
 */

import { floorOfPlace } from "../model/floors";
import { isolated, label, shortPlace, objectClass } from "../model/names";
import { robotAt } from "./keyframes";
import { isPlaceLit, litObject } from "./lit";
import { placeColour, withAlpha } from "./palette";
import type { Scene } from "./scene";
import type { Surface } from "./surface";
import { objectRadius } from "./things";
import { NEAR, screenX, screenY } from "./view";

export const FONT = 'system-ui, "Segoe UI", Roboto, "Helvetica Neue", "Noto Sans", Arial, sans-serif';
const PLACE_FONT = `600 13px ${FONT}`;
const SMALL_FONT = `11px ${FONT}`;
const LIT_FONT = `600 12px ${FONT}`;
const FAR_FONT = `600 11px ${FONT}`;
const MOST = 400;
/** On a map narrower than this a label is a name only, until it is seen from nearer. */
const NARROW_PX = 520;

interface Wanted {
  x: number;
  y: number;
  /** Pixels from the anchor at which the label begins; 0 puts it on the anchor. */
  away: number;
  text: string;
  second?: string;
  /** Whether it may stand beside its anchor. */
  strays?: boolean;
  font: string;
  colour: string;
  chip?: string;
  /** Before all others: what is pointed at, selected or found. */
  first?: boolean;
}

export interface Box {
  x: number;
  y: number;
  width: number;
  height: number;
}

export function drawLabels(on: Surface, scene: Scene) {
  const [taken, avoided] = [reserved(scene), signs(scene)];
  const wanted = [...goneLabels(scene), ...placeLabels(scene), ...objectLabels(scene), ...edgeLabels(scene)];
  for (const each of [...wanted.filter(({ first }) => first), ...wanted.filter(({ first }) => !first)].slice(0, MOST)) {
    draw(on, scene, each, taken, avoided);
  }
}

/** What labels must not cover: the robot, where an answer is drawn, controls. */
function reserved(scene: Scene): Box[] {
  const { bridge, lost, view, controls, history } = scene;
  const robot = robotAt(scene);
  const spots = [
    ...(bridge?.chains.flatMap((chain) => chain.points) ?? []),
    ...(lost === null ? [] : [lost.pose, lost.truth, ...lost.others, ...lost.evidence]),
  ];
  const marked = spots.flatMap((spot) => (spot === null ? [] : [{ x: screenX(view, spot.x) - 12, y: screenY(view, spot.y) - 24, width: 24, height: 48 }]));
  const { x, y } = history.keyframes;
  return [...marked, ...(robot < 0 ? [] : [about(screenX(view, x[robot]), screenY(view, y[robot]), 11)]), ...controls];
}

function about(x: number, y: number, reach: number): Box {
  return { x: x - reach, y: y - reach, width: 2 * reach, height: 2 * reach };
}

/** The signs of objects, which labels cover only where they find no other spot. */
function signs({ layers, view, map, history }: Scene): Box[] {
  if (!layers.objects || view.k < NEAR) return [];
  const { x, y, confirmed } = history.changes;
  return map.objects
    .map((object) => map.objectRow[object])
    .filter((row) => layers.once || confirmed[row] === 1)
    .map((row) => about(screenX(view, x[row]), screenY(view, y[row]), objectRadius(view.k)));
}

/** The places that a difference says are gone. */
function goneLabels({ difference, history, palette, view }: Scene): Wanted[] {
  if (difference === null) return [];
  const { before } = difference;
  return [...difference.difference.places]
    .filter(([place, change]) => change === "gone" && before.standsAs[place] === place)
    .map(([place]) => ({
      x: screenX(view, before.x[place]),
      y: screenY(view, before.y[place]),
      away: 0,
      text: `${isolated(label(shortPlace(history, place)))} gone`,
      font: FAR_FONT,
      colour: palette.removed,
      first: true,
    }));
}

function placeLabels(scene: Scene): Wanted[] {
  const { history, map, view, palette } = scene;
  const order = [...map.places].sort((a, b) => map.size[b] - map.size[a]);
  const near = view.k >= NEAR * (scene.width < NARROW_PX ? 2 : 1);
  return order.map((place) => ({
    x: screenX(view, map.x[place]),
    y: screenY(view, map.y[place]),
    away: 0,
    text: isolated(label(map.name[place] ?? shortPlace(history, place), near ? 28 : 16)),
    second: near || isPlaceLit(scene, place) ? [map.size[place], map.name[place] === null && scene.types.get(history.placeIds[place])?.type].filter(Boolean).join(" · ") : undefined,
    font: near ? PLACE_FONT : FAR_FONT,
    strays: near,
    colour: palette.ink,
    chip: placeColour(palette, history, place),
    first: isPlaceLit(scene, place),
  }));
}

function edgeLabels(scene: Scene): Wanted[] {
  const { history, map, view, palette } = scene;
  if (!scene.layers.edges || view.k < NEAR) return [];
  return map.edges.map(({ a, b, count }) => ({
    x: screenX(view, (map.x[a] + map.x[b]) / 2),
    y: screenY(view, (map.y[a] + map.y[b]) / 2),
    away: 0,
    text: floorOfPlace(history, a) === floorOfPlace(history, b) ? `${count}×` : `${count}× between floors`,
    font: SMALL_FONT,
    colour: palette.dim,
  }));
}

function objectLabels(scene: Scene): Wanted[] {
  const { history, map, view, palette } = scene;
  if (!scene.layers.objects) return [];
  const lit = [litObject(scene, scene.selection), litObject(scene, scene.hovered)];
  const { x, y, count, missing, confirmed } = history.changes;
  const isShown = (object: number) => scene.layers.once || confirmed[map.objectRow[object]] === 1 || lit.includes(object) || scene.found.has(object);
  const first = (object: number) => lit.includes(object) || scene.found.has(object);
  const rank = (object: number) => (lit.includes(object) ? 1e9 : scene.found.has(object) ? 1e8 : 0) + count[map.objectRow[object]];
  return map.objects
    .filter(isShown)
    .filter((object) => view.k >= NEAR || first(object) || missing[map.objectRow[object]])
    .sort((a, b) => rank(b) - rank(a))
    .map((object) => {
      const row = map.objectRow[object];
      const name = isolated(label(objectClass(history, map, object), 22));
      return {
        x: screenX(view, x[row]),
        y: screenY(view, y[row]),
        away: objectRadius(view.k) + 4,
        text: missing[row] ? `${name} missing` : name,
        font: lit.includes(object) ? LIT_FONT : SMALL_FONT,
        colour: lit.includes(object) || scene.found.has(object) ? palette.accent : missing[row] ? palette.removed : palette.dim,
        first: first(object),
      };
    });
}

const DIRECTIONS: readonly (readonly [number, number])[] = [
  [1, 0], [-1, 0], [0, 1], [0, -1], [0.8, 0.8], [0.8, -0.8], [-0.8, 0.8], [-0.8, -0.8],
];
const NUDGES: readonly (readonly [number, number])[] = [
  [0, 0], [0, -24], [0, 24], [44, 0], [-44, 0], [44, -24], [-44, 24], [0, -48], [0, 48],
];

function draw(on: Surface, scene: Scene, wanted: Wanted, taken: Box[], avoided: readonly Box[]) {
  if (!(wanted.x > -20 && wanted.y > -20 && wanted.x < scene.width + 20 && wanted.y < scene.height + 20)) return;
  const main = widthOf(on, wanted.font, wanted.text);
  const second = wanted.second === undefined ? 0 : widthOf(on, SMALL_FONT, wanted.second) + 6;
  const width = main + second + (wanted.chip === undefined ? 4 : 24);
  const height = wanted.chip === undefined ? 15 : 21;
  const spots = candidates(wanted, width, height, scene.width);
  const all = spots.filter(
    (box) =>
      box.x >= 2 && box.y >= 2 && box.x + width <= scene.width - 2 && box.y + height <= scene.height - 2 &&
      !taken.some((other) => overlap(box, other)),
  );
  if (all.length === 0) return;
  const free = all.find((box) => !avoided.some((sign) => overlap(box, sign))) ?? all[0];
  taken.push(free);
  write(on, scene, wanted, free, main);
}

const widths = new Map<string, number>();
const MOST_WIDTHS = 5000;

/** Measured once: while dragging the same texts are asked for again and again. */
function widthOf(on: Surface, font: string, text: string): number {
  const key = `${font} ${text}`;
  let width = widths.get(key);
  if (width === undefined) {
    if (widths.size >= MOST_WIDTHS) widths.clear();
    on.font = font;
    width = on.measureText(text).width;
    widths.set(key, width);
  }
  return width;
}

function candidates({ x, y, away, strays, first }: Wanted, width: number, height: number, most: number): Box[] {
  if (away === 0) {
    // Near an edge of the picture the label stands inside it.
    const inside = (left: number) => Math.max(3, Math.min(most - width - 3, left));
    return (strays === false && !first ? NUDGES.slice(0, 1) : NUDGES).map(([dx, dy]) => ({ x: inside(x - width / 2 + dx), y: y - height / 2 + dy, width, height }));
  }
  return DIRECTIONS.map(([dx, dy]) => ({
    x: x + dx * (away + width / 2) - width / 2,
    y: y + dy * (away + height / 2) - height / 2,
    width,
    height,
  }));
}

export function overlap(a: Box, b: Box): boolean {
  return a.x < b.x + b.width && b.x < a.x + a.width && a.y < b.y + b.height && b.y < a.y + a.height;
}

function write(on: Surface, scene: Scene, wanted: Wanted, box: Box, main: number) {
  const { palette } = scene;
  const middle = box.y + box.height / 2;
  let x = box.x + 2;
  if (wanted.chip !== undefined) {
    on.beginPath();
    on.rect(box.x, box.y, box.width, box.height);
    on.fillStyle = withAlpha(palette.ground, 0.88);
    on.fill();
    on.strokeStyle = withAlpha(wanted.chip, 0.9);
    on.lineWidth = 1;
    on.stroke();
    on.beginPath();
    on.rect(box.x, box.y, 4, box.height);
    on.fillStyle = wanted.chip;
    on.fill();
    x = box.x + 11;
  }
  on.textAlign = "left";
  on.textBaseline = "middle";
  on.font = wanted.font;
  if (wanted.chip === undefined) {
    on.strokeStyle = palette.halo;
    on.lineWidth = 3;
    on.lineJoin = "round";
    on.strokeText(wanted.text, x, middle);
  }
  on.fillStyle = wanted.colour;
  on.fillText(wanted.text, x, middle + 0.5);
  if (wanted.second !== undefined) {
    on.font = SMALL_FONT;
    on.fillStyle = palette.dim;
    on.fillText(wanted.second, x + main + 6, middle + 0.5);
  }
}
