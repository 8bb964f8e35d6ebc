/** One floor of a map of several: its history and its map without what is on the others. */

import type { History } from "../history/types";
import type { MapDifference } from "./compare";
import { type MapState, rowsBefore } from "./map_at";

/** The number of the floor that has no name. */
const UNNAMED = -1;
const found = new WeakMap<History, number[]>();
const parts = new WeakMap<History, Map<number, History>>();

/** The numbers of the floors that poses are on, by their names; that without a name comes last. */
export function floorsOf(history: History): number[] {
  let floors = found.get(history);
  if (floors === undefined) {
    const { floor, x } = history.keyframes;
    const names = history.floors;
    floors = [...new Set(floor.filter((_, each) => !Number.isNaN(x[each])))];
    floors.sort((a, b) => Number(a < 0) - Number(b < 0) || names[a].localeCompare(names[b], "en", { numeric: true }));
    found.set(history, floors);
  }
  return floors;
}

export const floorName = (history: History, floor: number) => (floor === UNNAMED ? "without a name" : history.floors[floor]);

/** That of the first pose: occupancy maps are of it. */
export function firstFloor({ keyframes: { floor, yaw } }: History): number {
  return floor[yaw.findIndex((each) => !Number.isNaN(each))];
}

/** A place is on the floor of its founder. */
export const floorOfPlace = (history: History, place: number) => history.keyframes.floor[history.founded.founder[place]];

/** An object is on the floor of the keyframe that saw it first. */
export const floorOfObject = (history: History, object: number) =>
  history.keyframes.floor[rowsBefore(history.keyframes.offset, history.found.offset[object])];

/** The history in which keyframes of other floors have no position. */
function partOf(history: History, floor: number): History {
  let floors = parts.get(history);
  if (floors === undefined) parts.set(history, (floors = new Map()));
  let part = floors.get(floor);
  if (part === undefined) {
    const { keyframes } = history;
    const here = (values: Float32Array) => values.map((value, each) => (keyframes.floor[each] === floor ? value : Number.NaN));
    part = { ...history, keyframes: { ...keyframes, x: here(keyframes.x), y: here(keyframes.y) } };
    floors.set(floor, part);
  }
  return part;
}

export interface Shown {
  history: History;
  map: MapState;
}

/** What is on a floor; null is all. Ways between floors stay with both of them. */
export function onFloor({ history, map }: Shown, floor: number | null): Shown {
  if (floor === null) return { history, map };
  const here = (place: number) => floorOfPlace(history, place) === floor;
  return {
    history: partOf(history, floor),
    map: {
      ...map,
      places: map.places.filter(here),
      objects: map.objects.filter((object) => floorOfObject(history, object) === floor),
      edges: map.edges.filter(({ a, b }) => here(a) || here(b)),
    },
  };
}

export function differenceOn(history: History, difference: MapDifference, floor: number | null): MapDifference {
  if (floor === null) return difference;
  const kept = <T>(things: Map<number, T>, floorOf: typeof floorOfPlace) => new Map([...things].filter(([thing]) => floorOf(history, thing) === floor));
  return {
    ...difference,
    places: kept(difference.places, floorOfPlace),
    objects: kept(difference.objects, floorOfObject),
    shifts: difference.shifts.filter(({ object }) => floorOfObject(history, object) === floor),
  };
}
