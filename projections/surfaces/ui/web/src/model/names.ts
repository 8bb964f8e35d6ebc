/** Names of things as people read them, and things by their names. */

import type { History } from "../history/types";
import type { MapState } from "./map_at";

/** RUN/ID of a keyframe, as requests and links name it. */
export function keyframeId(history: History, keyframe: number): string {
  const { run, id } = history.keyframes;
  return `${history.runIds[run[keyframe]]}/${id[keyframe]}`;
}

/** The ordinal of a keyframe given as RUN/ID, RUN:ID, or ID alone where there is one run; or -1. */
export function findKeyframe(history: History, text: string): number {
  const parts = /^(?:(.*)[/:])?(-?\d{1,19})$/s.exec(text);
  if (parts === null) return -1;
  const run = parts[1] === undefined ? (history.runIds.length === 1 ? 0 : -1) : history.runIds.indexOf(parts[1]);
  const wanted = BigInt(parts[2]);
  const { run: runs, id } = history.keyframes;
  for (let each = 0; each < runs.length; each++) {
    if (id[each] === wanted && runs[each] === run) return each;
  }
  return -1;
}

/** RUN:ID, as commands and answers write a keyframe. */
export const keyframeTitle = (id: string) => id.replace(/\/(?=[^/]*$)/, ":");

const placeNumbers = new WeakMap<History, Map<string, number>>();
const objectNumbers = new WeakMap<History, Map<string, number>>();

function numberOf(cache: WeakMap<History, Map<string, number>>, history: History, ids: string[], id: string): number {
  let numbers = cache.get(history);
  if (numbers === undefined) {
    numbers = new Map(ids.map((each, number) => [each, number]));
    cache.set(history, numbers);
  }
  return numbers.get(id) ?? -1;
}

export const findPlace = (history: History, id: string) => numberOf(placeNumbers, history, history.placeIds, id);
export const findObject = (history: History, id: string) => numberOf(objectNumbers, history, history.objectIds, id);

const shortPlaces = new WeakMap<History, string[]>();

/** `p7` where no other place has this number, else the id without what all ids begin with: `a_p7` for `house-a_p7`. */
export function shortPlace(history: History, place: number): string {
  let found = shortPlaces.get(history);
  if (found === undefined) {
    const ids = history.placeIds;
    const numbers = ids.map((id) => /_(p\d+)$/.exec(id)?.[1] ?? id);
    const used = new Map<string, number>();
    for (const each of numbers) used.set(each, (used.get(each) ?? 0) + 1);
    let same = 0;
    while (ids.length > 1 && same < ids[0].length && ids.every((id) => id[same] === ids[0][same])) same++;
    const start = (/^.*[-_:/.]/.exec(ids[0]?.slice(0, same) ?? "")?.[0] ?? "").length;
    found = numbers.map((each, number) => (used.get(each) === 1 ? each : ids[number].slice(start)));
    shortPlaces.set(history, found);
  }
  return found[place];
}

/** `obj-` and six digits, as in commands. */
export const shortObject = (id: string) => id.slice(0, 10);

/** What a place is called, or its short id. */
export function placeTitle(history: History, map: MapState, place: number): string {
  return map.name[place] ?? shortPlace(history, place);
}

export function objectClass(history: History, map: MapState, object: number): string {
  const row = map.objectRow[object];
  return row < 0 ? "" : (history.classes[history.changes.class[row]] ?? "");
}

/** Control characters, those that turn the direction of what follows, and those without a width. */
const PLAIN = /[\u0000-\u001f\u007f-\u009f\u00ad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff]/g;

/** A text of the log on one line, short enough for a label; control characters become visible. */
export function label(text: string, most = 28): string {
  const plain = text.replace(PLAIN, "\ufffd");
  const characters = Array.from(plain.slice(0, 4 * most));
  return characters.length <= most ? plain : `${characters.slice(0, most - 1).join("")}…`;
}

/** Isolated, so that a text written from right to left does not turn what stands beside it. */
export function isolated(text: string): string {
  return `\u2068${text}\u2069`;
}

export const counted = (count: number, what: string, many = `${what}s`) =>
  `${count.toLocaleString("en")} ${count === 1 ? what : many}`;
