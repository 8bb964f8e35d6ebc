/**
 * The region of each place as closed outlines: its free floor, where the server has sent it. Of
 * other places all that lies near one of their keyframes and nearer to it than to any other place's
 * (marching squares over a grid of distances).
 */

import type { Geometry } from "../api/types";
import type { History } from "../history/types";
import { type MapState, NONE } from "./map_at";

export const REACH_M = 0.55;
const FINEST_STEP_M = 0.14;
const MOST_STEPS = 200;

export interface Region {
  place: number;
  /** Closed outlines in metres: x0, y0, x1, y1 … */
  loops: Float32Array[];
}

export interface Grid {
  step: number;
  x0: number;
  y0: number;
  columns: number;
  rows: number;
}

export interface Regions {
  regions: Region[];
  /** The place whose region a point in metres is in, or NONE. */
  placeAt(x: number, y: number): number;
}

export interface Bounds {
  x0: number;
  y0: number;
  x1: number;
  y1: number;
}

export function boundsOf(history: History): Bounds | null {
  const { x, y } = history.keyframes;
  const found = { x0: Infinity, y0: Infinity, x1: -Infinity, y1: -Infinity };
  const include = (px: number, py: number) => {
    if (px < found.x0) found.x0 = px;
    if (px > found.x1) found.x1 = px;
    if (py < found.y0) found.y0 = py;
    if (py > found.y1) found.y1 = py;
  };
  for (let each = 0; each < x.length; each++) include(x[each], y[each]);
  return found.x0 <= found.x1 ? found : null;
}

export function gridOf({ x0, y0, x1, y1 }: Bounds): Grid {
  const step = Math.max(FINEST_STEP_M, (x1 - x0) / MOST_STEPS, (y1 - y0) / MOST_STEPS);
  const margin = reachOf(step) + 3 * step;
  return {
    step,
    x0: x0 - margin,
    y0: y0 - margin,
    columns: Math.ceil((x1 - x0 + 2 * margin) / step) + 1,
    rows: Math.ceil((y1 - y0 + 2 * margin) / step) + 1,
  };
}

/** On a coarse grid regions reach further, or they would fall between its points. */
function reachOf(step: number): number {
  return Math.max(REACH_M, 1.5 * step);
}

/** The rings of a geometry, in metres from the origin of a history. */
export function ringsOf(geometry: Geometry, [ox, oy]: readonly [number, number]): Float32Array[] {
  const polygons = geometry.type === "Polygon" ? [geometry.coordinates] : geometry.coordinates;
  return polygons.flat().map((ring) => Float32Array.from(ring.slice(1).flatMap(([x, y]) => [x - ox, y - oy])));
}

/** `floors` is the free floor of places that have one. */
export function regionsOf(history: History, map: MapState, grid: Grid, floors: ReadonlyMap<number, Float32Array[]>): Regions {
  const known = map.places.flatMap((place) => {
    const loops = floors.get(place);
    return loops ? { place, loops } : [];
  });
  const near = known.length === map.places.length ? null : nearRegions(history, map, grid);
  return {
    regions: [...known, ...(near?.regions ?? []).filter(({ place }) => !floors.has(place))],
    placeAt(x, y) {
      const on = known.find(({ loops }) => isInside(loops, x, y));
      if (on !== undefined) return on.place;
      const beside = near?.placeAt(x, y) ?? NONE;
      return floors.has(beside) ? NONE : beside;
    },
  };
}

/** Whether a point is within rings, by the even-odd rule. */
function isInside(loops: Float32Array[], x: number, y: number): boolean {
  let inside = false;
  for (const loop of loops) {
    for (let i = 0; i < loop.length; i += 2) {
      const [x0, y0] = loop.subarray(i - 2); // of the first point the last one
      const [x1, y1] = loop.subarray(i);
      if (y0 > y !== y1 > y && x < x0 + ((y - y0) / (y1 - y0)) * (x1 - x0)) inside = !inside;
    }
  }
  return inside;
}

function nearRegions(history: History, map: MapState, grid: Grid): Regions {
  const { owner, distance } = nearest(history, map, grid);
  const reach = reachOf(grid.step);
  return {
    regions: outlines(grid, owner, distance, reach),
    placeAt(x, y) {
      const column = Math.round((x - grid.x0) / grid.step);
      const row = Math.round((y - grid.y0) / grid.step);
      if (column < 0 || row < 0 || column >= grid.columns || row >= grid.rows) return NONE;
      const point = row * grid.columns + column;
      return distance[point] < reach ? owner[point] : NONE;
    },
  };
}

function nearest(history: History, map: MapState, grid: Grid) {
  const { columns, rows, step, x0, y0 } = grid;
  const owner = new Int32Array(columns * rows).fill(NONE);
  const far = reachOf(step) + 1.5 * step;
  const distance = new Float32Array(columns * rows);
  const stamped = new Int32Array(columns * rows).fill(NONE);
  const { x: xs, y: ys } = history.keyframes;
  const reach = Math.ceil(far / step);
  // Squares of distances in steps, and no temporary arrays: this loop runs while dragging.
  const squares = new Float32Array(columns * rows).fill((far / step) ** 2);
  for (let each = 0; each < map.keyframeCount; each++) {
    const place = map.placeOf[each];
    if (place === NONE || Number.isNaN(xs[each])) continue;
    const x = (xs[each] - x0) / step;
    const y = (ys[each] - y0) / step;
    const column = Math.round(x);
    const row = Math.round(y);
    const cell = row * columns + column;
    if (stamped[cell] === place) continue; // another of this place is at most a step away
    stamped[cell] = place;
    const left = Math.max(0, column - reach);
    const right = Math.min(columns - 1, column + reach);
    const top = Math.min(rows - 1, row + reach);
    for (let r = Math.max(0, row - reach); r <= top; r++) {
      const dy = r - y;
      for (let c = left, point = r * columns + left; c <= right; c++, point++) {
        const dx = c - x;
        const square = dx * dx + dy * dy;
        if (square < squares[point]) {
          squares[point] = square;
          owner[point] = place;
        }
      }
    }
  }
  for (let point = 0; point < squares.length; point++) distance[point] = Math.sqrt(squares[point]) * step;
  return { owner, distance };
}

const [BOTTOM, RIGHT, TOP, LEFT] = [0, 1, 2, 3];
/** By which corners are inside (bits: lower left, lower right, upper right, upper left) the lines
 * through a cell, from edge to edge, the inside on their left. */
const LINES: readonly (readonly [number, number])[][] = [
  [],
  [[BOTTOM, LEFT]],
  [[RIGHT, BOTTOM]],
  [[RIGHT, LEFT]],
  [[TOP, RIGHT]],
  [[BOTTOM, LEFT], [TOP, RIGHT]],
  [[TOP, BOTTOM]],
  [[TOP, LEFT]],
  [[LEFT, TOP]],
  [[BOTTOM, TOP]],
  [[RIGHT, BOTTOM], [LEFT, TOP]],
  [[RIGHT, TOP]],
  [[LEFT, RIGHT]],
  [[BOTTOM, RIGHT]],
  [[LEFT, BOTTOM]],
  [],
];

function outlines(grid: Grid, owner: Int32Array, distance: Float32Array, reach: number): Region[] {
  const { columns, rows } = grid;
  /** By place, from each crossed edge of the grid to the next one of the outline. */
  const next = new Map<number, Map<number, number>>();
  const corners = [0, 0, 0, 0];
  for (let row = 0; row + 1 < rows; row++) {
    for (let column = 0; column + 1 < columns; column++) {
      const base = row * columns + column;
      corners[0] = distance[base] < reach ? owner[base] : NONE;
      corners[1] = distance[base + 1] < reach ? owner[base + 1] : NONE;
      corners[2] = distance[base + columns + 1] < reach ? owner[base + columns + 1] : NONE;
      corners[3] = distance[base + columns] < reach ? owner[base + columns] : NONE;
      if (corners[0] === corners[1] && corners[1] === corners[2] && corners[2] === corners[3]) continue;
      for (let k = 0; k < 4; k++) {
        const place = corners[k];
        if (place === NONE || corners.indexOf(place) !== k) continue;
        let bits = 0;
        for (let j = 0; j < 4; j++) if (corners[j] === place) bits |= 1 << j;
        let lines = next.get(place);
        if (lines === undefined) next.set(place, (lines = new Map()));
        for (const [from, to] of LINES[bits]) {
          lines.set(edgeOf(base, columns, from), edgeOf(base, columns, to));
        }
      }
    }
  }
  const inside = (place: number, point: number) =>
    owner[point] === place ? reach - distance[point] : -Math.abs(reach - distance[point]) - 1e-6;
  return [...next].map(([place, lines]) => ({
    place,
    loops: loopsOf(lines, grid, (point) => inside(place, point)),
  }));
}

/** Number of a cell's edge: twice that of the grid point where it starts, plus one if upright. */
function edgeOf(base: number, columns: number, side: number): number {
  if (side === BOTTOM) return 2 * base;
  if (side === TOP) return 2 * (base + columns);
  return side === LEFT ? 2 * base + 1 : 2 * (base + 1) + 1;
}

function loopsOf(
  lines: Map<number, number>,
  grid: Grid,
  value: (point: number) => number,
): Float32Array[] {
  const loops: Float32Array[] = [];
  while (lines.size > 0) {
    const [start] = lines.keys();
    const loop: number[] = [];
    let edge: number | undefined = start;
    while (edge !== undefined && lines.has(edge)) {
      const to: number = lines.get(edge) as number;
      lines.delete(edge);
      const point = edge >> 1;
      const other = edge & 1 ? point + grid.columns : point + 1;
      const [a, b] = [value(point), value(other)];
      const share = a === b ? 0.5 : Math.min(1, Math.max(0, a / (a - b)));
      const [row, column] = [Math.floor(point / grid.columns), point % grid.columns];
      loop.push(
        grid.x0 + (column + (edge & 1 ? 0 : share)) * grid.step,
        grid.y0 + (row + (edge & 1 ? share : 0)) * grid.step,
      );
      edge = to;
    }
    loops.push(Float32Array.from(loop));
  }
  return loops;
}
