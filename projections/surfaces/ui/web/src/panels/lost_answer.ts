/** The answer to "where am I?", and what it draws on the map. */

import type { History } from "../history/types";
import type { LostOverlay } from "../map/scene";
import { floorOfObject } from "../model/floors";
import { findObject, findPlace, isolated, label } from "../model/names";
import { map, shownFloor } from "../state/store";

export interface LostAnswer {
  places: {
    place_id: string;
    name?: string | null;
    score: number;
    evidence: { similarity: number; class_name: string; object_id: string | null; det_id: string }[];
  }[];
  pose: { x: number; y: number; yaw: number | null; spread_m: number; floor?: string } | null;
  confidence: number;
  unknown: boolean;
  command?: string;
  seconds: number;
  /** The weighed poses: x, y, yaw and weight. */
  poses: [number, number, number | null, number][];
  /** Where it may be, likeliest first: each with the weight of all poses about it. */
  spots: { x: number; y: number; floor: string | null; share: number }[];
  /** The floor of each of them, where floors have names. */
  pose_floors?: (string | null)[];
}

export interface Truth {
  x: number;
  y: number;
  yaw: number | null;
  floor: number;
}

/** Side of a cell of the heat map, metres. */
const CELL_M = 0.25;

export function overlayOf(answer: LostAnswer, truth: Truth | null, history: History): LostOverlay {
  const shown = map.peek();
  const floor = shownFloor.value;
  const here = (number: number) => floor === null || number === floor;
  const named = (name: string | null | undefined) => here(history.floors.indexOf(name ?? ""));
  const [ox, oy] = history.origin;
  const first = answer.places[0];
  const evidence = (first?.evidence ?? []).flatMap((each) => {
    const object = each.object_id === null ? -1 : findObject(history, each.object_id);
    const row = object < 0 || shown === null || shown.objectStandsAs[object] < 0 ? -1 : shown.objectRow[shown.objectStandsAs[object]];
    if (row < 0 || !here(floorOfObject(history, object))) return [];
    const text = `${isolated(label(each.class_name, 18))} ${each.similarity.toFixed(2)}`;
    const place = history.changes.place[row];
    const now = place < 0 || shown === null ? -1 : shown.standsAs[place];
    return [{ x: history.changes.x[row], y: history.changes.y[row], text, place: now }];
  });
  return {
    cells: cellsOf(answer.poses.filter((_, each) => named(answer.pose_floors?.[each])), history),
    pose: answer.pose === null || answer.pose === undefined || !named(answer.pose.floor) ? null : { x: answer.pose.x - ox, y: answer.pose.y - oy, yaw: answer.pose.yaw, spread: answer.pose.spread_m },
    others: answer.spots.slice(1).filter((spot) => named(spot.floor)).map(({ x, y, share }) => ({ x: x - ox, y: y - oy, share })),
    truth: truth === null || !here(truth.floor) ? null : { ...truth, x: truth.x - ox, y: truth.y - oy },
    evidence: unique(evidence),
    places: new Set(answer.places.slice(0, 1).map((place) => findPlace(history, place.place_id))),
  };
}

function unique(evidence: LostOverlay["evidence"]): LostOverlay["evidence"] {
  const seen = new Map<string, LostOverlay["evidence"][number]>();
  for (const each of evidence) {
    const key = `${each.x} ${each.y}`;
    if (!seen.has(key)) seen.set(key, each);
  }
  return [...seen.values()];
}

function cellsOf(poses: LostAnswer["poses"], { origin }: History): LostOverlay["cells"] {
  const cells = new Map<string, LostOverlay["cells"][number]>();
  for (const [x, y, , weight] of poses) {
    const [column, row] = [Math.floor((x - origin[0]) / CELL_M), Math.floor((y - origin[1]) / CELL_M)];
    const key = `${column} ${row}`;
    const cell = cells.get(key);
    if (cell !== undefined) cell.share += weight;
    else cells.set(key, { x: (column + 0.5) * CELL_M, y: (row + 0.5) * CELL_M, size: CELL_M, share: weight });
  }
  return [...cells.values()];
}
