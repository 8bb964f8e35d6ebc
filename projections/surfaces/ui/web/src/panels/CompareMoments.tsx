/** What changed between two moments, chosen by run and day; drawn on the map, too. Only what is sure counts. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { address } from "../api/client";
import type { MapChange, MapChanges, MapFacts } from "../api/types";
import { bringIntoView } from "../map/MapCanvas";
import type { History } from "../history/types";
import { counted, label, placeTitle } from "../model/names";
import { goTo, positionOf } from "../state/actions";
import { type Asked, useAnswer } from "../state/answers";
import { difference, sureChanges } from "../state/overlays";
import * as store from "../state/store";
import { Answer, ChangeLine, CommandLine, ThingLink, shortTime } from "./AnswerParts";

interface DiffAnswer {
  same: boolean;
  lines: string[];
  command: string;
}

/** A moment to choose: after its last event a run or a day is over. */
interface Choice {
  says: string;
  start: number;
  end: number;
}

function choices(history: History): { runs: Choice[]; days: Choice[] } {
  const { offset, run, stamp } = history.keyframes;
  const [runs, days] = [new Map<string, Choice>(), new Map<string, Choice>()];
  const take = (into: Map<string, Choice>, says: string, at: number) => {
    const known = into.get(says);
    if (known === undefined) into.set(says, { says, start: at, end: at + 1 });
    else known.end = at + 1;
  };
  for (let each = 0; each < offset.length; each++) {
    take(runs, history.runIds[run[each]], offset[each]);
    const day = Math.floor(stamp[each] / 86_400);
    if (Math.abs(day) < 1e8) take(days, new Date(day * 86_400_000).toISOString().slice(0, 10), offset[each]);
  }
  return { runs: [...runs.values()], days: [...days.values()] };
}

const kept = new WeakMap<History, ReturnType<typeof choices>>();

function MomentChoice({ says, history, value, end, onChange }: { says: string; history: History; value: number | null; end: boolean; onChange: (at: number) => void }) {
  let all = kept.get(history);
  if (all === undefined) kept.set(history, (all = choices(history)));
  const { runs, days } = all;
  const at = (each: Choice) => (end ? each.end : each.start);
  const known = value === null || (!end && value === store.at.value) || [...runs, ...days].some((each) => at(each) === value);
  const options = (name: string, of: Choice[]) =>
    of.length > 0 && (
      <optgroup label={name}>
        {of.map((each) => (
          <option key={each.says} value={String(at(each))}>{label(each.says, 40)}</option>
        ))}
      </optgroup>
    );
  return (
    <label>
      {says}
      <select value={value === null ? "" : String(value)} onChange={(event) => event.currentTarget.value !== "" && onChange(Number(event.currentTarget.value))}>
        {value === null && <option value="">choose …</option>}
        {!end && <option value={String(store.at.value)}>the moment shown</option>}
        {!known && <option value={String(value)}>{momentText(history, value as number)}</option>}
        {options("Runs", runs)}
        {options("Days", days)}
      </select>
    </label>
  );
}

/** The time of the last keyframe before a moment. */
function momentText(history: History, at: number): string {
  const { offset, stamp } = history.keyframes;
  let last = -1;
  for (let each = 0; each < offset.length && offset[each] < at; each++) last = each;
  if (last < 0) return "the beginning";
  const seconds = stamp[last];
  return Math.abs(seconds) < 8.6e12 ? `${shortTime(new Date(seconds * 1000).toISOString(), history)}, event ${at}` : `event ${at}`;
}

const active = signal(0);

/** To the next change, or the one before, which the map then shows. */
export function walkChanges(step: 1 | -1): boolean {
  const changes = sureChanges.value ?? [];
  if (changes.length === 0) return false;
  show(changes, Math.max(0, Math.min(changes.length - 1, active.value + step)));
  document.querySelector(`#change-${active.value}`)?.scrollIntoView({ block: "nearest" });
  return true;
}

function show(changes: readonly MapChange[], number: number) {
  active.value = number;
  const change = changes[number];
  const thing = { kind: "object", id: change.object_id } as const;
  store.hovered.value = thing;
  const at = positionOf(thing);
  if (at !== null) bringIntoView(...at);
}

export function CompareMoments() {
  const history = store.history.value;
  const other = store.compareWith.value;
  const at = store.restedAt.value;
  const ready = history !== null && other !== null && other <= history.through && at <= history.through && other <= at;
  const asked = useAnswer<MapChanges>(ready ? address("/api/changes", { since: other, until: at, known_at: history.knownAt }) : null, history?.state);
  const maps = useAnswer<DiffAnswer>(ready ? address("/api/diff", { from: other, to: at, known_at: history.knownAt }) : null, history?.state);
  const then = useAnswer<MapFacts>(ready && store.beside.value ? address("/api/overview", { at: other, known_at: history.knownAt }) : null, history?.state).value;
  useEffect(() => {
    store.otherFacts.value = then;
  }, [then]);
  const changes = ready ? (asked.value?.changes ?? null) : null;
  useEffect(() => {
    sureChanges.value = changes;
    active.value = -1;
  }, [changes]);
  useEffect(() => {
    if (other === null && history !== null) {
      const { runs } = choices(history);
      if (runs.length > 1) store.compareWith.value = runs[runs.length - 1].start;
    }
    return () => {
      sureChanges.value = null;
      store.hovered.value = null;
    };
  }, []);
  if (history === null) return null;
  return (
    <>
      <div class="moments">
        <MomentChoice says="From the start of" history={history} value={other} end={false} onChange={(value) => (store.compareWith.value = value)} />
        <MomentChoice says="to the end of" history={history} value={store.at.value} end onChange={goTo} />
      </div>
      {other === null && <p class="dim">Choose a run or a day to begin with. The map marks what is new, gone and moved since.</p>}
      {other !== null && other > at && <p class="dim">The end is before the start; choose a later run or day.</p>}
      {ready && (
        <>
          <label class="check">
            <input type="checkbox" checked={store.beside.value} onChange={() => (store.beside.value = !store.beside.value)} />
            before and after side by side
          </label>
          {asked.error !== null ? <p class="note">{asked.error.message}</p> : <SureChanges asked={asked} history={history} />}
          <PlaceCounts />
          <Answer asked={maps}>
            {(answer) => (
              <>
                {answer.same ? (
                  <p class="summary">The two maps are the same.</p>
                ) : (
                  <details>
                    <summary>How the two maps differ</summary>
                    <pre class="lines" tabIndex={0} aria-label="Difference as text">{answer.lines.join("\n")}</pre>
                    <CommandLine command={answer.command} />
                  </details>
                )}
              </>
            )}
          </Answer>
        </>
      )}
    </>
  );
}

function SureChanges({ asked, history }: { asked: Asked<MapChanges>; history: History }) {
  return (
    <Answer asked={asked}>
      {({ changes, counts, unsure, command }) => (
        <>
          <p class="summary">
            {changes.length === 0 ? "Nothing changed for sure" : Object.entries(counts).filter(([, count]) => count > 0).map(([kind, count]) => `${count.toLocaleString("en")} ${kind}`).join(", ")}
            {unsure > 0 && <span class="dim"> + {unsure.toLocaleString("en")} not sure</span>}
            {changes.length > 1 && <span class="dim"> · ↑ ↓ walk through them</span>}
          </p>
          <ol class="changes walked">
            {changes.map((each, number) => (
              <ChangeLine key={each.kind + each.object_id} id={`change-${number}`} current={active.value === number} change={each} history={history} />
            ))}
          </ol>
          <CommandLine command={command} />
        </>
      )}
    </Answer>
  );
}

/** Counted by the page itself, while dragging. */
function PlaceCounts() {
  const [found, history, map] = [difference.value, store.history.value, store.map.value];
  if (found === null || history === null || map === null) return null;
  const { difference: changes } = found;
  const row = (sign: string, kind: string, says: string) => {
    const places = [...changes.places].filter(([, each]) => each === kind).map(([number]) => number);
    if (places.length === 0) return null;
    return (
      <li>
        <span class={`sign-${kind}`} aria-hidden="true">{sign}</span>
        <div>
          <b>{counted(places.length, "place")} {says}</b>
          <ul class="chips">
            {places.slice(0, 24).map((number) => <li key={number}><ThingLink thing={{ kind: "place", id: history.placeIds[number] }}>{label(placeTitle(history, map, number), 32)}</ThingLink></li>)}
            {places.length > 24 && <li class="dim">and {places.length - 24} more</li>}
          </ul>
        </div>
      </li>
    );
  };
  return (
    <>
      <p class="dim counts">
        {counted(changes.newKeyframes.length, "new keyframe")}, {counted(changes.movedKeyframes.length, "keyframe")} in another place
      </p>
      <ul class="changes">
        {row("+", "new", "new")}
        {row("×", "gone", "gone")}
      </ul>
    </>
  );
}
