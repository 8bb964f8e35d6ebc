/** What the map holds at W; its digest on demand. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { address } from "../api/client";
import type { MapFacts } from "../api/types";
import type { History } from "../history/types";
import { floorName, floorsOf } from "../model/floors";
import { counted, isolated, label } from "../model/names";
import { useAnswer } from "../state/answers";
import * as store from "../state/store";
import { objectsText } from "./summary";

/** Whether the digest is shown. */
const open = signal(false);

export function Digest() {
  const [map, history] = [store.map.value, store.history.value];
  const at = store.restedAt.value;
  const there = history !== null && at <= history.through;
  const moment = { at, known_at: store.knownAt(at) };
  const asked = useAnswer<MapFacts & { command: string }>(there ? address("/api/overview", moment) : null);
  const digested = useAnswer<{ at: number; known_at: number; digest: string }>(there && open.value ? address("/api/digest", moment) : null);
  useEffect(() => {
    const found = (store.mapFacts.value = asked.value);
    store.stateCommand.value = found === null ? null : { at: found.at, command: found.command };
  }, [asked.value]);
  if (map === null || history === null) return null;
  const facts = store.mapFactsNow.value;
  const digest = facts !== null && digested.value?.at === facts.at && digested.value.known_at === facts.known_at ? digested.value.digest : "";
  return (
    <div class="facts" data-whole={facts !== null}>
      <p>
        <b title="Parts of the building, found from where robots drove">{counted(map.places.length, "place")}</b>
        <span class="minor" title="Moments at which a robot told where it was and what it saw">{counted(map.keyframeCount, "keyframe")}</span>
        <span title="Things that were seen from several spots or at several times; those seen once are often errors of a detector">{objectsText(history, map)}</span>
        {map.noise > 0 && <span class="minor" title="Keyframes with too few others near them">{map.noise.toLocaleString("en")} in no place</span>}
        <button type="button" class="link" aria-expanded={open.value} title="SHA-256 of the whole map: equal maps have equal digests" onClick={() => (open.value = !open.value)}>
          {open.value ? "hide digest" : "show digest"}
        </button>
        {open.value && <code title={digest} data-digest={digest}>{digest.slice(0, 16) || "…"}</code>}
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
