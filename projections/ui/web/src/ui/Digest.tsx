/** What the map holds at W, and its digest. */

import { useEffect } from "preact/hooks";
import { address } from "../api/client";
import { counted } from "../model/names";
import { useAnswer } from "../state/answers";
import * as store from "../state/store";

export function Digest() {
  const [map, history] = [store.map.value, store.history.value];
  const at = store.restedAt.value;
  const path = history === null || at > history.through ? null : address("/api/digest", { at, known_at: history.knownAt });
  const asked = useAnswer<{ at: number; digest: string; command: string }>(path);
  useEffect(() => {
    const found = asked.value;
    store.stateCommand.value = found === null ? null : { at: found.at, command: found.command.replace(/ --digest\b/, "") };
  }, [asked.value]);
  if (map === null || history === null) return null;
  const current = asked.value !== null && asked.value.at === store.at.value;
  return (
    <div class="facts">
      <p>
        <b>{counted(map.places.length, "place")}</b>
        <span>{counted(map.keyframeCount, "keyframe")}</span>
        <span>{counted(map.objects.length, "object")}</span>
        {map.noise > 0 && <span>{map.noise.toLocaleString("en")} in no place</span>}
      </p>
      <p class="digest" title={asked.value?.digest ?? ""}>
        digest <code data-digest={current ? asked.value?.digest : ""}>{current ? asked.value?.digest.slice(0, 16) : "…"}</code>
      </p>
    </div>
  );
}
