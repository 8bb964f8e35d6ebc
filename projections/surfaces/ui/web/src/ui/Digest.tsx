/** What the map holds at W, and its digest. */

import { useEffect } from "preact/hooks";
import { address } from "../api/client";
import type { MapFacts } from "../api/types";
import type { History } from "../history/types";
import { floorName, floorsOf } from "../model/floors";
import { counted, isolated, label } from "../model/names";
import { useAnswer } from "../state/answers";
import * as store from "../state/store";
import { objectsText } from "./summary";

export function Digest() {
  const [map, history] = [store.map.value, store.history.value];
  const at = store.restedAt.value;
  const path = history === null || at > history.through ? null : address("/api/digest", { at, known_at: store.knownAt(at) });
  const asked = useAnswer<MapFacts & { command: string }>(path);
  useEffect(() => {
    const found = (store.mapFacts.value = asked.value);
    store.stateCommand.value = found === null ? null : { at: found.at, command: found.command.replace(/ --digest\b/, "") };
  }, [asked.value]);
  if (map === null || history === null) return null;
  const digest = store.mapFactsNow.value?.digest ?? "";
  return (
    <div class="facts">
      <p>
        <b>{counted(map.places.length, "place")}</b>
        <span>{counted(map.keyframeCount, "keyframe")}</span>
        <span>{objectsText(history, map)}</span>
        {map.noise > 0 && <span>{map.noise.toLocaleString("en")} in no place</span>}
      </p>
      <p class="digest" title={digest}>
        digest <code data-digest={digest}>{digest.slice(0, 16) || "…"}</code>
      </p>
      <FloorChoice history={history} />
    </div>
  );
}

/** Which floor the map shows, where there are several. */
function FloorChoice({ history }: { history: History }) {
  const shown = store.shownFloor.value;
  if (shown === null) return null;
  const name = (floor: number) => isolated(label(floorName(history, floor)));
  return (
    <label class="floor">
      floor
      <select value={store.floor.value === null ? "" : String(shown)} onChange={({ currentTarget: { value } }) => (store.floor.value = value === "" ? null : Number(value))}>
        <option value="">{store.floor.value === null ? `${name(shown)}, the robot’s` : "the robot’s"}</option>
        {floorsOf(history).map((each) => (
          <option key={each} value={String(each)}>{name(each)}</option>
        ))}
      </select>
      <span class="dim">{counted(store.shown.value?.map.places.length ?? 0, "place")} on it</span>
    </label>
  );
}
