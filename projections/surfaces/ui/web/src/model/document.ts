/** The map at W as JSON. */

import type { MapFacts, Room } from "../api/types";
import { floorOfPlace } from "./floors";
import type { History } from "../history/types";
import { placeNow } from "./compare";
import type { MapState } from "./map_at";
import { keyframeId } from "./names";

/** `facts` are those of the same W, null while the server has not sent them. */
export function stateDocument(history: History, map: MapState, facts: MapFacts | null) {
  const rooms = new Map(facts?.rooms.map((each) => [each.place_id, each]));
  const place = (number: number) => (number < 0 ? null : history.placeIds[number]);
  const [ox, oy] = history.origin;
  const { keyframes, changes, floors } = history;
  return {
    at: map.at,
    known_at: history.knownAt,
    settings: history.settings,
    places: map.places.map((each) => ({
      place_id: history.placeIds[each],
      name: map.name[each],
      keyframes: map.size[each],
      ...(floors.length > 0 && { floor: floors[floorOfPlace(history, each)] ?? null }),
      ...knownOf(rooms.get(history.placeIds[each])),
      centroid_x: map.x[each] + ox,
      centroid_y: map.y[each] + oy,
    })),
    objects: map.objects.map((each) => {
      const row = map.objectRow[each];
      return {
        object_id: history.objectIds[each],
        class_name: history.classes[changes.class[row]],
        x: changes.x[row] + ox,
        y: changes.y[row] + oy,
        observations: changes.count[row],
        place_id: place(placeNow(history, map, row)),
        missing: changes.missing[row] === 1,
        confirmed: changes.confirmed[row] === 1,
      };
    }),
    keyframes: Array.from({ length: map.keyframeCount }, (_, each) => ({
      keyframe: keyframeId(history, each),
      offset: keyframes.offset[each],
      pose: Number.isNaN(keyframes.x[each]) ? null : [keyframes.x[each] + ox, keyframes.y[each] + oy, keyframes.yaw[each]],
      place_id: place(map.placeOf[each]),
    })),
    adjacency: map.edges.map(({ a, b, count }) => ({ a: history.placeIds[a], b: history.placeIds[b], shared_transitions: count })),
  };
}

function knownOf(room: Room | undefined) {
  if (room === undefined) return {};
  const { type, type_probability, region, area_m2 } = room;
  return { ...(type_probability !== null && { type, type_probability }), ...(region !== null && { region, area_m2 }) };
}
