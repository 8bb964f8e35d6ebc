/** The map at a glance: what changed, what is odd, rooms and objects. All of it is what `mapfold` answers. */

import { useEffect, useRef, useState } from "preact/hooks";
import { address } from "../api/client";
import { isSaved } from "../api/saved";
import type { Crop, FoundObject, FoundObjects, MapChanges, MapFacts, Room } from "../api/types";
import type { History } from "../history/types";
import { counted, findPlace, isolated, keyframeId, keyframeTitle, label, shortPlace } from "../model/names";
import { rowsBefore } from "../model/map_at";
import { openPanel } from "../state/actions";
import { useAnswer } from "../state/answers";
import * as store from "../state/store";
import { Answer, ChangeLine, CommandLine, Moment, ThingLink, shortTime } from "./AnswerParts";

const FEW_ROOMS = 10;
const FEW_CHANGES = 5;
const FEW_OBJECTS = 12;
const MOST_OBJECTS = 200;
const MOST_MERGES = 300;
const ASK_AFTER_MS = 250;

export function Overview({ history }: { history: History }) {
  const facts = store.mapFacts.value;
  const at = store.restedAt.value;
  if (facts === null || at > history.through) return <p class="dim" role="status">Loading rooms and objects …</p>;
  return (
    <section class={store.mapFactsNow.value === null ? "story stale" : "story"}>
      {isSaved && facts.at !== store.at.value && <p class="dim">The tables are as of event {facts.at.toLocaleString("en")}: this page was saved with some moments of them.</p>}
      <Changed history={history} at={facts.at} />
      <Odd odd={facts.odd} />
      <Rooms history={history} rooms={facts.rooms} />
      <Objects history={history} facts={facts} />
      <Merges history={history} at={facts.at} />
    </section>
  );
}

/** What changed since the last run began, where others were before it. */
function Changed({ history, at }: { history: History; at: number }) {
  const runs = store.log.value?.runs.filter(({ first_offset }) => first_offset < at) ?? [];
  const known = store.log.value?.fusion === "evidence" && runs.length > 1;
  const since = isSaved ? runs[runs.length - 1]?.first_offset : null; // an answer that has this name
  const asked = useAnswer<MapChanges>(known ? address("/api/changes", { since, until: at, known_at: store.knownAt(at) }) : null, history.state);
  const found = asked.value;
  if (isSaved && asked.error !== null) return null; // saved for the ends of runs
  if (asked.error !== null) return <Answer asked={asked}>{() => null}</Answer>;
  if (found === null || found.since === 0) return null;
  const { offset, run } = history.keyframes;
  const compare = () => {
    store.compareWith.value = found.since;
    store.compareMode.value = "moments";
    openPanel("compare");
  };
  return (
    <section class="changed">
      <h2>
        Since <bdi>{label(history.runIds[run[rowsBefore(offset, found.since)]] ?? "", 28)}</bdi> began
      </h2>
      <Answer asked={asked}>
        {({ changes, unsure }) => (
          <>
            {changes.length === 0 && <p class="dim">Nothing changed for sure.</p>}
            <ol class="changes">
              {changes.slice(0, FEW_CHANGES).map((each) => <ChangeLine key={each.kind + each.object_id} change={each} history={history} />)}
            </ol>
            {(changes.length > FEW_CHANGES || unsure > 0) && (
              <p class="dim">
                {changes.length > FEW_CHANGES && <button type="button" class="link" onClick={compare}>all {changes.length.toLocaleString("en")}</button>} {unsure > 0 && `+ ${unsure.toLocaleString("en")} not sure`}
              </p>
            )}
          </>
        )}
      </Answer>
    </section>
  );
}

function Odd({ odd }: { odd: MapFacts["odd"] }) {
  if (odd.length === 0) return null;
  return (
    <details class="odd">
      <summary>{counted(odd.length, "thing")} to improve: {odd.map(({ says }) => says.split(/[.:]/)[0].toLowerCase()).join("; ")}</summary>
      <ul>
        {odd.map(({ says, command }) => (
          <li key={says}>
            <p>{says}</p>
            <CommandLine command={command} />
          </li>
        ))}
      </ul>
    </details>
  );
}

/** What a place is called, and its short id beside that. */
function RoomName({ history, id, name, type }: { history: History; id: string; name: string | null; type: string | null }) {
  const place = findPlace(history, id);
  const short = place < 0 ? id : shortPlace(history, place);
  const word = name ?? type;
  return (
    <>
      <ThingLink thing={{ kind: "place", id }}>{label(word ?? short, 30)}</ThingLink>
      {word !== null && <bdi class="dim"> {label(short, 14)}</bdi>}
    </>
  );
}

function Rooms({ history, rooms }: { history: History; rooms: Room[] }) {
  const [all, setAll] = useState(false);
  const areas = rooms.some(({ area_m2 }) => area_m2 !== null);
  const floors = new Set(rooms.map(({ floor }) => floor)).size > 1;
  const what = store.log.value?.places_rule === "rooms" ? "room" : "place";
  return (
    <section>
      <h2>{counted(rooms.length, what)}</h2>
      {rooms.length === 0 ? (
        <p class="dim">A place is founded where enough keyframes are near each other.</p>
      ) : (
        <table class="rooms">
          <thead>
            <tr>
              <th scope="col">{what}</th>
              {floors && <th scope="col">floor</th>}
              {areas && <th scope="col">area</th>}
              <th scope="col">objects</th>
              <th scope="col">last visited</th>
            </tr>
          </thead>
          <tbody>
            {rooms.slice(0, all ? rooms.length : FEW_ROOMS).map((each) => (
              <tr key={each.place_id}>
                <th scope="row"><RoomName history={history} id={each.place_id} name={each.name} type={each.type} /></th>
                {floors && <td>{isolated(label(each.floor ?? "–", 10))}</td>}
                {areas && <td>{each.area_m2 === null ? "–" : `${each.area_m2.toFixed(each.area_m2 < 10 ? 1 : 0)} m²`}</td>}
                <td title={each.unconfirmed > 0 ? `and ${each.unconfirmed} seen once` : undefined}>{each.objects.toLocaleString("en")}</td>
                <td title={each.last_visited.iso}>{shortTime(each.last_visited.iso, history)}</td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
      {rooms.length > FEW_ROOMS && <button type="button" class="link" onClick={() => setAll(!all)}>{all ? "fewer" : `all ${rooms.length.toLocaleString("en")}`}</button>}
    </section>
  );
}

const { asked, sorted } = store;
const roomOf = (each: FoundObject) => each.place_name ?? each.place_type ?? each.place_id ?? "";
const ORDER: Record<store.Column, (a: FoundObject, b: FoundObject) => number> = {
  class: (a, b) => a.class_name.localeCompare(b.class_name),
  room: (a, b) => roomOf(a).localeCompare(roomOf(b)),
  seen: (a, b) => a.obs_count - b.obs_count,
  "last seen": (a, b) => a.last_seen.iso.localeCompare(b.last_seen.iso),
};

function Objects({ history, facts: { at, rooms, crops } }: { history: History; facts: MapFacts }) {
  const { what, room, every } = asked.value;
  const [all, setAll] = useState(false);
  const timer = useRef(0);
  useEffect(() => () => clearTimeout(timer.current), []);
  const listed = rooms.some(({ place_id }) => place_id === room) ? room : "";
  const moment = { all: every ? 1 : null, at, known_at: store.knownAt(at) };
  const question = isSaved ? moment : { what: what.trim(), in: listed, top: MOST_OBJECTS, ...moment };
  const answered = useAnswer<FoundObjects>(address("/api/find", question), history.state);
  const found = isSaved ? { ...answered, value: answered.value === null ? null : namedAlike(answered.value, what, listed) } : answered;
  const ask = (changed: Partial<typeof asked.value>) => (asked.value = { ...asked.value, ...changed });
  const type = (value: string) => {
    clearTimeout(timer.current);
    timer.current = window.setTimeout(() => ask({ what: value }), ASK_AFTER_MS);
  };
  return (
    <section>
      <h2>{found.value === null ? "Objects" : `${counted(found.value.count, "object")}${found.value.unconfirmed > 0 ? ` + ${found.value.unconfirmed.toLocaleString("en")} seen once` : ""}`}</h2>
      <div class="form-row filters">
        <input type="text" aria-label="Only objects that are" placeholder="all classes" spellcheck={false} autoComplete="off" value={what} onInput={(event) => type(event.currentTarget.value)} />
        <select aria-label="Only objects in" value={listed} onChange={(event) => ask({ room: event.currentTarget.value })}>
          <option value="">anywhere</option>
          {rooms.map(({ place_id, name, type: kind }) => (
            <option key={place_id} value={place_id}>{[name ?? kind, shortPlace(history, findPlace(history, place_id))].filter(Boolean).map((each) => label(String(each), 20)).join(" ")}</option>
          ))}
        </select>
        <label class="check" title="Also objects seen from one spot and at one time only, which are often errors of a detector">
          <input type="checkbox" checked={every} onChange={() => ask({ every: !every })} />
          seen once
        </label>
      </div>
      <Answer asked={found}>
        {({ answers, count }) => (
          <>
            {count > answers.length && <p class="dim">These are the first {answers.length.toLocaleString("en")}; ask for a class or a room to see others.</p>}
            {answers.length > 0 && <ObjectTable answers={answers} history={history} crops={crops} most={all ? MOST_OBJECTS : FEW_OBJECTS} />}
            {answers.length > FEW_OBJECTS && <button type="button" class="link" onClick={() => setAll(!all)}>{all ? "fewer" : `all ${answers.length.toLocaleString("en")}`}</button>}
          </>
        )}
      </Answer>
    </section>
  );
}

/** Of all objects those in a room whose class has a text: a saved page cannot ask what a word means. */
function namedAlike(all: FoundObjects, what: string, room: string): FoundObjects {
  const wanted = what.trim().toLowerCase();
  if (wanted === "" && room === "") return all;
  const answers = all.answers.filter((each) => each.class_name.toLowerCase().includes(wanted) && (room === "" || each.place_id === room));
  return { ...all, answers, count: answers.length, unconfirmed: 0 };
}

function ObjectTable({ answers, history, crops, most }: { answers: FoundObject[]; history: History; crops: boolean; most: number }) {
  const { by, down } = sorted.value;
  const rows = [...answers].sort((a, b) => (down ? -1 : 1) * ORDER[by](a, b)).slice(0, most);
  const head = (name: store.Column) => (
    <th scope="col" aria-sort={by !== name ? "none" : down ? "descending" : "ascending"}>
      <button type="button" onClick={() => (sorted.value = { by: name, down: by === name ? !down : name === "seen" || name === "last seen" })}>
        {name}{by === name && <span aria-hidden="true">{down ? " ↓" : " ↑"}</span>}
      </button>
    </th>
  );
  return (
    <table class="objects">
      <thead>
        <tr>
          {crops && <th scope="col"><span class="hidden">picture</span></th>}
          {head("class")}{head("room")}{head("seen")}{head("last seen")}
        </tr>
      </thead>
      <tbody>
        {rows.map((each) => (
          <tr key={each.object_id} class={each.missing_in === null ? undefined : "missing"} title={each.missing_in === null ? undefined : `missing in ${label(each.missing_in, 60)}`}>
            {crops && <td><Thumb id={each.object_id} name={each.class_name} /></td>}
            <th scope="row"><ThingLink thing={{ kind: "object", id: each.object_id }}>{label(each.class_name, 24)}</ThingLink></th>
            <td>{each.place_id === null ? <span class="dim">none</span> : <RoomName history={history} id={each.place_id} name={each.place_name} type={each.place_type} />}</td>
            <td>{each.obs_count.toLocaleString("en")}</td>
            <td title={each.last_seen.iso}>{shortTime(each.last_seen.iso, history)}</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}

/** The best picture of an object, asked for when it comes into view. */
function Thumb({ id, name }: { id: string; name: string }) {
  const ref = useRef<HTMLSpanElement>(null);
  const [near, setNear] = useState(false);
  useEffect(() => {
    const watch = new IntersectionObserver((seen) => {
      if (seen.some(({ isIntersecting }) => isIntersecting)) setNear(true);
    });
    watch.observe(ref.current as HTMLSpanElement);
    return () => watch.disconnect();
  }, []);
  const at = store.restedAt.value;
  const crop = useAnswer<{ pictures: Crop[] }>(near ? address("/api/pictures", { what: `object:${id}`, top: 1, at, known_at: store.knownAt(at) }) : null).value?.pictures[0];
  return <span ref={ref} class="thumb">{crop !== undefined && <img src={`data:image/jpeg;base64,${crop.jpeg}`} alt={label(name, 40)} />}</span>;
}

function Merges({ history, at }: { history: History; at: number }) {
  const { offset, survivor, absorbed, keyframe } = history.merges;
  if (offset.length === 0) return null;
  return (
    <details>
      <summary>{counted(offset.length, "merge")} of places</summary>
      <ol class="merges">
        {Array.from(offset.slice(0, MOST_MERGES), (each, row) => (
          <li key={row} class={each < at ? "past" : "ahead"}>
            <Moment offset={each} />
            <ThingLink thing={{ kind: "merge", id: String(each) }}>
              {label(shortPlace(history, survivor[row]))} ← {label(shortPlace(history, absorbed[row]))}
            </ThingLink>
            <span class="dim">
              <bdi>{label(keyframeTitle(keyframeId(history, keyframe[row])), 24)}</bdi>
            </span>
          </li>
        ))}
        {offset.length > MOST_MERGES && <li class="dim">and {counted(offset.length - MOST_MERGES, "more merge")}; the timeline marks them all</li>}
      </ol>
    </details>
  );
}
