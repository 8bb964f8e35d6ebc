/** Finds things by what a person types: places and keyframes in the history that the page has; the
 * answers of the server about Objects and what is not in the map now. */

import type { FoundObject, NamedThing, Room } from "../api/types";
import type { History } from "../history/types";
import type { Thing } from "../state/store";
import type { MapState } from "./map_at";
import { counted, findKeyframe, findPlace, keyframeId, keyframeTitle, shortObject, shortPlace } from "./names";

export interface Hit {
  thing: Thing;
  title: string;
  more: string;
  /** The event that brought it, if it is not in the map now. */
  from: number | null;
}

const MOST_PLACES = 12;

export function searchLocally(history: History, map: MapState, types: ReadonlyMap<string, Pick<Room, "type">>, typed: string): Hit[] {
  const wanted = typed.trim().toLowerCase();
  if (wanted === "") return [];
  return [...places(history, map, types, wanted), ...keyframes(history, map, typed.trim())];
}

function places(history: History, map: MapState, types: ReadonlyMap<string, Pick<Room, "type">>, wanted: string): Hit[] {
  const hits: { hit: Hit; rank: number }[] = [];
  history.placeIds.forEach((id, place) => {
    const names = [map.name[place], map.standsAs[place] === place ? types.get(id)?.type : null].filter((each) => typeof each === "string");
    const rank = rankOf([...names, shortPlace(history, place), id], wanted);
    if (rank !== null) hits.push({ hit: placeHit(history, map, place, names[0]), rank });
  });
  return hits.sort((a, b) => a.rank - b.rank).slice(0, MOST_PLACES).map(({ hit }) => hit);
}

/** How well the best of some names fits; null where none has the text. */
function rankOf(names: string[], wanted: string): number | null {
  const ranks = names.map((each) => each.toLowerCase()).map((name) => (name === wanted ? 0 : name.startsWith(wanted) ? 1 : name.includes(wanted) ? 2 : 3));
  const best = Math.min(...ranks);
  return best === 3 ? null : best;
}

function placeHit(history: History, map: MapState, place: number, name: string | undefined): Hit {
  const [short, now] = [shortPlace(history, place), map.standsAs[place]];
  const more = now < 0 ? "not yet founded" : now === place ? counted(map.size[place], "keyframe") : `part of ${shortPlace(history, now)}`;
  return {
    thing: { kind: "place", id: history.placeIds[place] },
    title: name ?? short,
    more: name === undefined ? more : `${short} · ${more}`,
    from: now < 0 ? history.founded.offset[place] : null,
  };
}

function keyframes(history: History, map: MapState, typed: string): Hit[] {
  const keyframe = findKeyframe(history, typed);
  if (keyframe < 0) return [];
  const offset = history.keyframes.offset[keyframe];
  const id = keyframeId(history, keyframe);
  return [{ thing: { kind: "keyframe", id }, title: keyframeTitle(id), more: `event ${offset}`, from: keyframe < map.keyframeCount ? null : offset }];
}

/** An answer of `find`: its room, how often and when last it was seen. */
export function foundHit(history: History, found: FoundObject): Hit {
  const place = found.place_id === null ? -1 : findPlace(history, found.place_id);
  const room = found.place_name ?? found.place_type;
  const where = place < 0 ? "in no place" : [room, shortPlace(history, place)].filter(Boolean).join(" ");
  const last = `last ${found.last_seen.iso.slice(0, 16).replace("T", " ")}`;
  const missing = found.missing_in === null ? [] : [`missing in ${found.missing_in}`];
  return {
    thing: { kind: "object", id: found.object_id },
    title: found.class_name,
    more: [where, ...missing, `seen ${counted(found.obs_count, "time")}`, last, shortObject(found.object_id)].join(" · "),
    from: null,
  };
}

/** A thing that the server finds by its name. */
export function namedHit(history: History, map: MapState, named: NamedThing): Hit | null {
  const from = named.stands ? null : named.offset;
  if (named.kind === "place") return placeHit(history, map, named.number, map.name[named.number] ?? undefined);
  if (named.kind === "object") {
    const seen = map.objectRow[named.number] < 0 ? "not in the map now" : `seen ${counted(history.changes.count[map.objectRow[named.number]], "time")}`;
    return { thing: { kind: "object", id: named.id }, title: named.text, more: `${seen} · ${shortObject(named.id)}`, from: named.offset < map.at ? null : named.offset };
  }
  if (named.kind === "detection") return { thing: { kind: "keyframe", id: keyframeId(history, named.number) }, title: named.id, more: named.text, from };
  return null;
}
