/** Every merge of the log and the places of the map now: where a person begins. */

import type { History } from "../history/types";
import { floorName, floorOfPlace, floorsOf } from "../model/floors";
import { counted, isolated, label, placeTitle, shortPlace } from "../model/names";
import { keyframeId } from "../model/names";
import * as store from "../state/store";
import { Moment, ThingLink } from "./AnswerParts";

const MOST = 300;

export function Overview({ history }: { history: History }) {
  const map = store.restedMap.value;
  if (map === null) return null;
  const { offset, survivor, absorbed, keyframe } = history.merges;
  const floors = floorsOf(history);
  const places = [...map.places].sort((a, b) => map.size[b] - map.size[a]);
  return (
    <section class="story">
      <h2>{offset.length === 0 ? "No merges" : counted(offset.length, "merge")}</h2>
      {offset.length === 0 ? (
        <p class="dim">No places of this log merged. Select a thing on the map to see what happened to it.</p>
      ) : (
        <ol class="merges">
          {Array.from(offset.slice(0, MOST), (at, row) => (
            <li key={row} class={at < map.at ? "past" : "ahead"}>
              <Moment offset={at} />
              <ThingLink thing={{ kind: "merge", id: String(at) }}>
                {label(shortPlace(history, survivor[row]))} ← {label(shortPlace(history, absorbed[row]))}
              </ThingLink>
              <span class="dim">
                <bdi>{label(keyframeId(history, keyframe[row]), 24)}</bdi>
              </span>
            </li>
          ))}
          {offset.length > MOST && <li class="dim">and {counted(offset.length - MOST, "more merge")}; the timeline marks them all</li>}
        </ol>
      )}
      <h2>{counted(places.length, "place")} now</h2>
      {places.length === 0 ? (
        <p class="dim">A place is founded where enough keyframes are near each other.</p>
      ) : (
        <ol class="places">
          {places.slice(0, MOST).map((place) => (
            <li key={place}>
              <ThingLink thing={{ kind: "place", id: history.placeIds[place] }}>{label(placeTitle(history, map, place), 40)}</ThingLink>
              <span class="dim">{[store.types.value.get(history.placeIds[place])?.type, floors.length > 1 && `floor ${isolated(label(floorName(history, floorOfPlace(history, place))))}`, counted(map.size[place], "keyframe")].filter(Boolean).join(", ")}</span>
            </li>
          ))}
        </ol>
      )}
    </section>
  );
}
