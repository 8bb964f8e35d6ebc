/**
 * The map after the first W events, from the history's arrays: one pass over each, no server.
 *
 * Every array of a history is sorted by offset, so the rows of the first W events are a prefix. A
 * keyframe's place is the one it joined, followed through the merges so far.
 */

import type { History } from "../history/types";

export const NONE = -1;

export interface MapState {
  /** W: the number of events that the map covers. */
  at: number;
  /** Keyframes recorded; ordinals below this are in the map. */
  keyframeCount: number;
  /** By keyframe, the place it is in, or NONE. */
  placeOf: Int32Array;
  /** By place, the place that it is part of now: itself while it stands, NONE before it is founded. */
  standsAs: Int32Array;
  /** By place, keyframes in it and their mean position; only for places that stand. */
  size: Int32Array;
  x: Float64Array;
  y: Float64Array;
  name: (string | null)[];
  places: number[];
  /** By object, the row of `history.changes` with its values, or NONE. */
  objectRow: Int32Array;
  objects: number[];
  /** By object, the object that it is part of now, or NONE before it is found. */
  objectStandsAs: Int32Array;
  /** Adjacent places and the number of drives between them. */
  edges: { a: number; b: number; count: number }[];
  /** Keyframes with a pose that are in no place. */
  noise: number;
}

/** Objects that are confirmed, and with `everything` those seen once, too. */
export function shownObjects(history: History, map: MapState, everything: boolean): number[] {
  const { confirmed } = history.changes;
  return everything ? map.objects : map.objects.filter((object) => confirmed[map.objectRow[object]] === 1);
}

/** How many rows of a sorted array are below `end`. */
export function rowsBefore(offsets: ArrayLike<number>, end: number): number {
  let [low, high] = [0, offsets.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (offsets[middle] < end) low = middle + 1;
    else high = middle;
  }
  return low;
}

export function mapAt(history: History, at: number): MapState {
  const standsAs = survivors(
    history.placeIds.length,
    history.founded.place,
    rowsBefore(history.founded.offset, at),
    history.merges.survivor,
    history.merges.absorbed,
    rowsBefore(history.merges.offset, at),
  );
  const objectStandsAs = survivors(
    history.objectIds.length,
    history.found.object,
    rowsBefore(history.found.offset, at),
    history.objectMerges.survivor,
    history.objectMerges.absorbed,
    rowsBefore(history.objectMerges.offset, at),
  );
  const keyframeCount = rowsBefore(history.keyframes.offset, at);
  const members = placeMembers(history, at, keyframeCount, standsAs);
  const objectRow = new Int32Array(history.objectIds.length).fill(NONE);
  const { object } = history.changes;
  for (let row = 0, end = rowsBefore(history.changes.offset, at); row < end; row++) {
    objectRow[object[row]] = row;
  }
  const objects: number[] = [];
  for (let number = 0; number < objectRow.length; number++) {
    if (objectStandsAs[number] === number && objectRow[number] !== NONE) objects.push(number);
    else objectRow[number] = NONE;
  }
  return {
    at,
    keyframeCount,
    standsAs,
    ...members,
    name: namesAt(history, at),
    objectRow,
    objects,
    objectStandsAs,
    edges: edgesAt(history, at),
  };
}

/** By thing the one that it is part of after some merges; NONE for one that is not there yet. */
function survivors(
  count: number,
  started: Int32Array,
  startedEnd: number,
  survivor: Int32Array,
  absorbed: Int32Array,
  mergedEnd: number,
): Int32Array {
  const into = new Int32Array(count).fill(NONE);
  for (let row = 0; row < startedEnd; row++) into[started[row]] = started[row];
  for (let row = 0; row < mergedEnd; row++) into[absorbed[row]] = survivor[row];
  for (let thing = 0; thing < count; thing++) {
    let root = into[thing];
    if (root === NONE) continue;
    while (into[root] !== root) root = into[root];
    for (let each = thing; into[each] !== root; ) {
      const next = into[each];
      into[each] = root;
      each = next;
    }
  }
  return into;
}

function placeMembers(history: History, at: number, keyframeCount: number, standsAs: Int32Array) {
  const { x: xs, y: ys } = history.keyframes;
  const count = standsAs.length;
  const placeOf = new Int32Array(keyframeCount).fill(NONE);
  const size = new Int32Array(count);
  const x = new Float64Array(count);
  const y = new Float64Array(count);
  const { keyframe, place } = history.placed;
  for (let row = 0, end = rowsBefore(history.placed.offset, at); row < end; row++) {
    placeOf[keyframe[row]] = place[row] < 0 ? NONE : standsAs[place[row]];
  }
  let noise = 0;
  for (let each = 0; each < keyframeCount; each++) {
    const in_ = placeOf[each];
    if (in_ === NONE) {
      if (xs[each] === xs[each]) noise++; // NaN is no pose
      continue;
    }
    size[in_]++;
    x[in_] += xs[each];
    y[in_] += ys[each];
  }
  const places: number[] = [];
  for (let each = 0; each < count; each++) {
    if (standsAs[each] !== each) continue;
    places.push(each);
    if (size[each] > 0) {
      x[each] /= size[each];
      y[each] /= size[each];
    }
  }
  return { placeOf, size, x, y, places, noise };
}

function namesAt(history: History, at: number): (string | null)[] {
  const names = new Array<string | null>(history.placeIds.length).fill(null);
  for (const { offset, place, name } of history.names) if (offset < at) names[place] = name;
  return names;
}

function edgesAt(history: History, at: number): MapState["edges"] {
  const { pair, count } = history.edges;
  const counts = new Int32Array(history.pairs.a.length);
  for (let row = 0, end = rowsBefore(history.edges.offset, at); row < end; row++) {
    counts[pair[row]] = count[row];
  }
  const edges: MapState["edges"] = [];
  for (let number = 0; number < counts.length; number++) {
    if (counts[number] > 0) {
      edges.push({
        a: history.pairs.a[number],
        b: history.pairs.b[number],
        count: counts[number],
      });
    }
  }
  return edges;
}
