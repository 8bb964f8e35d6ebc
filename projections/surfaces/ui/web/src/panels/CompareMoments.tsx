/** What is new, gone, moved and renamed between two moments; drawn on the map, too. */

import { address } from "../api/client";
import { counted, isolated, label, objectClass } from "../model/names";
import { goTo } from "../state/actions";
import { useAnswer } from "../state/answers";
import { difference } from "../state/overlays";
import * as store from "../state/store";
import { Answer, CommandLine, ThingLink } from "./AnswerParts";

interface DiffAnswer {
  same: boolean;
  lines: string[];
  command: string;
  places: {
    formed: { place_id: string; name?: string | null }[];
    gone: { place_id: string; into?: string }[];
    changed: { place_id: string }[];
  };
}

export function CompareMoments() {
  const history = store.history.value;
  const other = store.compareWith.value;
  const at = store.restedAt.value;
  const ready = history !== null && other !== null && other <= history.through && at <= history.through;
  const asked = useAnswer<DiffAnswer>(ready ? address("/api/diff", { from: other, to: at, known_at: history.knownAt }) : null, history?.state);
  if (history === null) return null;
  const set = (value: number) => {
    store.compareWith.value = Math.max(0, Math.min(history.through, value));
  };
  return (
    <>
      <div class="form-row">
        <label>
          From moment
          <input inputMode="numeric" value={other === null ? "" : String(other)} size={8} placeholder="none" onChange={(event) => set(Number(event.currentTarget.value.replace(/\D/g, "")))} />
        </label>
        <button type="button" class="button" onClick={() => set(store.at.value)}>
          Take {store.at.value}
        </button>
        <span class="dim">to {store.at.value}, where the timeline is</span>
      </div>
      {other === null ? (
        <p class="dim">Take the moment shown as the first one, then drag the timeline to the second. The map marks what is new, gone and moved in between.</p>
      ) : (
        <>
          <div class="form-row">
            <button type="button" class="button quiet" onClick={() => { const now = store.at.value; goTo(other); set(now); }}>
              Swap
            </button>
            <button type="button" class="button quiet" onClick={() => (store.compareWith.value = null)}>
              Compare nothing
            </button>
          </div>
          <DifferenceCounts />
          <Answer asked={asked}>
            {(answer) => (
              <>
                {answer.same ? <p class="summary">The two maps are the same.</p> : <pre class="lines" tabIndex={0} aria-label="Difference as text">{answer.lines.join("\n")}</pre>}
                <CommandLine command={answer.command} />
              </>
            )}
          </Answer>
        </>
      )}
    </>
  );
}

/** Counted by the page itself, while dragging. */
function DifferenceCounts() {
  const [found, history, map] = [difference.value, store.history.value, store.map.value];
  if (found === null || history === null || map === null) return null;
  const { difference: changes, before } = found;
  const of = (things: ReadonlyMap<number, string>, change: string) => [...things].filter(([, each]) => each === change).map(([number]) => number);
  const place = (number: number) => <ThingLink thing={{ kind: "place", id: history.placeIds[number] }}>{label(map.name[number] ?? history.placeIds[number], 32)}</ThingLink>;
  const object = (number: number) => (
    <ThingLink thing={{ kind: "object", id: history.objectIds[number] }}>
      {isolated(label(objectClass(history, map, number) || objectClass(history, before, number), 24))}
    </ThingLink>
  );
  const row = (sign: string, kind: string, says: string, numbers: number[], link: (number: number) => preact.JSX.Element) =>
    numbers.length > 0 && (
      <li key={says}>
        <span class={`sign-${kind}`} aria-hidden="true">{sign}</span>
        <div>
          <b>{says}</b>
          <ul class="chips">
            {numbers.slice(0, 24).map((number) => <li key={number}>{link(number)}</li>)}
            {numbers.length > 24 && <li class="dim">and {numbers.length - 24} more</li>}
          </ul>
        </div>
      </li>
    );
  const placed = (change: string) => of(changes.places, change);
  const stood = (change: string) => of(changes.objects, change);
  const moved = changes.shifts.map(({ object }) => object);
  const fresh = stood("new").filter((object) => history.changes.confirmed[map.objectRow[object]] === 1);
  const once = stood("new").length - fresh.length;
  return (
    <>
      <p class="summary">
        {counted(changes.newKeyframes.length, "new keyframe")}, {counted(changes.movedKeyframes.length, "keyframe")} in another place
      </p>
      <ul class="changes">
        {row("+", "new", counted(placed("new").length, "new place"), placed("new"), place)}
        {row("×", "gone", `${counted(placed("gone").length, "place")} gone`, placed("gone"), place)}
        {row("~", "changed", `${counted(placed("changed").length, "place")} changed`, placed("changed"), place)}
        {row("+", "new", `${counted(fresh.length, "new object")}${once > 0 ? ` + ${once.toLocaleString("en")} seen once` : ""}`, fresh, object)}
        {row("×", "gone", `${counted(stood("gone").length, "object")} gone`, stood("gone"), object)}
        {row("~", "changed", `${counted(stood("joined").length, "object")} joined into others`, stood("joined"), object)}
        {row("→", "moved", `${counted(moved.length, "object")} moved`, moved, object)}
      </ul>
    </>
  );
}
