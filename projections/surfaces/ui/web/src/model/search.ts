/** Finds things by what a person types, in the history that the page has. */

import type { History } from "../history/types";
import type { MapState } from "./map_at";
import { counted, findKeyframe, keyframeId } from "./names";

export interface Hit {
  thing: { kind: "place" | "object" | "keyframe" | "merge"; id: string };
  title: string;
  more: string;
  /** The event that brought it, if it is not in the map now. */
  from: number | null;
}

const MOST = 12;

export function searchLocally(history: History, map: MapState, typed: string): Hit[] {
  const wanted = typed.trim().toLowerCase();
  if (wanted === "") return [];
  const hits = [
    ...places(history, map, wanted),
    ...keyframes(history, map, typed.trim()),
    ...objects(history, map, wanted),
  ];
  return hits
    .map((hit, index) => ({ hit, index, rank: rank(hit, wanted) }))
    .sort((a, b) => a.rank - b.rank || a.index - b.index)
    .slice(0, MOST)
    .map(({ hit }) => hit);
}

function rank(hit: Hit, wanted: string): number {
  const names = [hit.title.toLowerCase(), hit.thing.id.toLowerCase()];
  if (names.includes(wanted)) return 0;
  if (names.some((name) => name.endsWith(`_${wanted}`))) return 1;
  return names.some((name) => name.startsWith(wanted)) ? 2 : 3;
}

function places(history: History, map: MapState, wanted: string): Hit[] {
  const hits: Hit[] = [];
  history.placeIds.forEach((id, place) => {
    const name = map.name[place];
    if (!id.toLowerCase().includes(wanted) && !name?.toLowerCase().includes(wanted)) return;
    const now = map.standsAs[place];
    const more =
      now < 0 ? "not yet founded" : now === place ? counted(map.size[place], "keyframe") : `part of ${history.placeIds[now]}`;
    hits.push({
      thing: { kind: "place", id },
      title: name ?? id,
      more: name === null ? more : `${id}, ${more}`,
      from: now < 0 ? history.founded.offset[place] : null,
    });
  });
  return hits;
}

function objects(history: History, map: MapState, wanted: string): Hit[] {
  const hits: Hit[] = [];
  for (let object = 0; object < history.objectIds.length && hits.length < 200; object++) {
    const row = map.objectRow[object];
    const kind = history.classes[row < 0 ? history.found.class[object] : history.changes.class[row]] ?? "";
    const id = history.objectIds[object];
    if (!kind.toLowerCase().includes(wanted) && !id.toLowerCase().includes(wanted)) continue;
    const absorbed = map.objectStandsAs[object] >= 0 && map.objectStandsAs[object] !== object;
    const more = row >= 0 ? `seen ${counted(history.changes.count[row], "time")}, ${id}` : `${id}, ${absorbed ? "part of another object" : "not yet found"}`;
    hits.push({
      thing: { kind: "object", id },
      title: kind,
      more,
      from: row < 0 && !absorbed ? history.found.offset[object] : null,
    });
  }
  return hits.sort((a, b) => Number(a.from !== null) - Number(b.from !== null));
}

function keyframes(history: History, map: MapState, typed: string): Hit[] {
  const keyframe = findKeyframe(history, typed);
  if (keyframe < 0) return [];
  const offset = history.keyframes.offset[keyframe];
  const id = keyframeId(history, keyframe);
  return [
    {
      thing: { kind: "keyframe", id },
      title: id,
      more: `event ${offset}`,
      from: keyframe < map.keyframeCount ? null : offset,
    },
  ];
}
