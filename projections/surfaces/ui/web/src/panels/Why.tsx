/** Why a thing is what it is, step by step; with nothing selected, every merge and place. */

import { useEffect } from "preact/hooks";
import { address } from "../api/client";
import { isSaved } from "../api/saved";
import type { Room, Step } from "../api/types";
import type { History } from "../history/types";
import type { MapState } from "../model/map_at";
import { floorName, floorOfObject, floorOfPlace, floorsOf } from "../model/floors";
import { placeNow } from "../model/compare";
import { counted, findKeyframe, findObject, findPlace, isolated, keyframeTitle, label, objectClass, placeTitle } from "../model/names";
import { openPanel, select } from "../state/actions";
import { useAnswer } from "../state/answers";
import { bridge } from "../state/overlays";
import * as store from "../state/store";
import { Icon } from "../ui/icons";
import { type MergeStory, BridgeView, bridgeOf } from "./BridgeView";
import { Overview } from "./Overview";
import { Way } from "./Way";
import { Pictures } from "./Pictures";
import { Answer, CommandLine, Lines, Linked, Steps, ThingLink } from "./AnswerParts";

interface WhyAnswer {
  kind: string;
  summary: string;
  lines: string[];
  steps: Step[];
  merges?: MergeStory[];
  command: string | null;
}

export function Why() {
  const thing = store.selection.value;
  const history = store.history.value;
  if (history === null) return null;
  return thing === null ? <Overview history={history} /> : <Story key={`${thing.kind} ${thing.id}`} thing={thing} history={history} />;
}

/** W that the story of a thing is asked at: now, or right after it is there. */
function momentOf(thing: store.Thing, history: History): number {
  const at = store.restedAt.value;
  const first = {
    merge: () => Number(thing.id),
    place: () => history.founded.offset[findPlace(history, thing.id)],
    object: () => history.found.offset[findObject(history, thing.id)],
    keyframe: () => history.keyframes.offset[findKeyframe(history, thing.id)],
  }[thing.kind]();
  return Math.min(history.through, Math.max(at, (first ?? 0) + 1));
}

function Story({ thing, history }: { thing: store.Thing; history: History }) {
  const at = momentOf(thing, history);
  const path = address("/api/why", { what: `${thing.kind}:${thing.id}`, at, known_at: store.knownAt(at) });
  const asked = useAnswer<WhyAnswer>(path, history.state);
  const merges = thing.kind === "merge" ? asked.value?.merges : undefined;
  useEffect(() => {
    bridge.value = merges === undefined ? null : bridgeOf(history, merges);
    return () => {
      bridge.value = null;
    };
  }, [merges, history]);
  return (
    <section class="story">
      <Heading thing={thing} history={history} />
      <Facts thing={thing} history={history} />
      {!isSaved && (thing.kind === "place" || thing.kind === "object") && <Way thing={thing} history={history} at={at} />}
      <Answer asked={asked}>
        {(answer) => (
          <>
            <p class="summary"><Linked text={answer.summary} refs={answer.steps?.flatMap(({ refs }) => refs ?? []) ?? []} /></p>
            {answer.merges?.map((merge) => <BridgeView key={merge.number} merge={merge} history={history} />)}
            <Pictures thing={thing} at={at} state={history.state} />
            {answer.kind === "merge" ? <Lines lines={answer.lines} /> : <Steps steps={answer.steps} />}
            <CommandLine command={answer.command} />
          </>
        )}
      </Answer>
    </section>
  );
}

function Heading({ thing, history }: { thing: store.Thing; history: History }) {
  const map = store.map.value as MapState;
  let title = thing.id;
  if (thing.kind === "place") {
    const place = findPlace(history, thing.id);
    title = place >= 0 ? placeTitle(history, map, place) : thing.id;
  } else if (thing.kind === "object") {
    const object = findObject(history, thing.id);
    const absorbed = history.classes[history.found.class[object]];
    title = object >= 0 ? objectClass(history, map, object) || absorbed || thing.id : thing.id;
  } else title = thing.kind === "merge" ? `Merge by event ${thing.id}` : keyframeTitle(thing.id);
  return (
    <header class="thing">
      <button class="icon" type="button" aria-label="Select nothing" title="Back to all rooms and objects (Esc)" onClick={() => select(null)}>
        <Icon name="back" />
      </button>
      <div>
        <span class="kind">{thing.kind}</span>
        <h2>
          <bdi>{label(title, 120)}</bdi>
        </h2>
        {title !== thing.id && (thing.kind === "place" || thing.kind === "object") && (
          <code class="id">
            <bdi>{label(thing.id, 120)}</bdi>
          </code>
        )}
      </div>
    </header>
  );
}

/** What the page knows by itself, at the moment shown. */
function Facts({ thing, history }: { thing: store.Thing; history: History }) {
  const map = store.map.value;
  if (map === null) return null;
  const facts = { place: placeFacts, object: objectFacts, keyframe: keyframeFacts, merge: () => [] }[thing.kind](thing, history, map);
  if (facts.length === 0) return null;
  return (
    <dl class="facts-list">
      {facts.map(([name, value]) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd>{value}</dd>
        </div>
      ))}
    </dl>
  );
}

type Fact = [string, preact.ComponentChildren];

function placeLink(history: History, map: MapState, place: number) {
  if (place < 0) return "no place";
  return <ThingLink thing={{ kind: "place", id: history.placeIds[place] }}>{label(placeTitle(history, map, place))}</ThingLink>;
}

function placeFacts(thing: store.Thing, history: History, map: MapState): Fact[] {
  const place = findPlace(history, thing.id);
  if (place < 0) return [];
  const now = map.standsAs[place];
  if (now < 0) return [["now", "not yet founded"]];
  if (now !== place) return [["now", <>part of {placeLink(history, map, now)}</>]];
  const inside = map.objects.filter((object) => placeNow(history, map, map.objectRow[object]) === place);
  const next = map.edges.filter(({ a, b }) => a === place || b === place);
  return [
    ["type", typeText(store.rooms.value.get(thing.id))],
    ...floorFact(history, floorOfPlace(history, place)),
    ["keyframes", map.size[place].toLocaleString("en")],
    ["centre", `(${map.x[place].toFixed(2)}, ${map.y[place].toFixed(2)}) m`],
    ["next to", next.length === 0 ? "nothing" : <ul class="chips">{next.map(({ a, b, count }) => <li key={`${a} ${b}`}>{placeLink(history, map, a === place ? b : a)} <span class="dim">{count}×</span></li>)}</ul>],
    ["objects", inside.length === 0 ? "none" : <ul class="chips">{inside.slice(0, 60).map((object) => <li key={object}><ThingLink thing={{ kind: "object", id: history.objectIds[object] }}>{label(objectClass(history, map, object), 20)}</ThingLink></li>)}{inside.length > 60 && <li class="dim">and {inside.length - 60} more</li>}</ul>],
  ];
}

/** What kind of room it is; the likeliest ones where that is unsure. */
function typeText(found: Room | undefined): string {
  if (found === undefined) return "…";
  if (found.type_probability === null) return "unknown";
  const percent = (share: number) => `${Math.round(share * 100)} %`;
  if (found.type !== null) return `${found.type} ${percent(found.type_probability)}`;
  return `unsure: ${found.candidates.map(([type, share]) => `${type} ${percent(share)}`).join(", ")}`;
}

function floorFact(history: History, floor: number): Fact[] {
  const floors = floorsOf(history);
  return floors.length < 2 ? [] : [["floor", `${isolated(label(floorName(history, floor)))}, of ${floors.length} of the building`]];
}

function objectFacts(thing: store.Thing, history: History, map: MapState): Fact[] {
  const object = findObject(history, thing.id);
  if (object < 0) return [];
  const now = map.objectStandsAs[object];
  if (now < 0) return [["now", "not yet found"]];
  if (now !== object) return [["now", <>part of <ThingLink thing={{ kind: "object", id: history.objectIds[now] }} /></>]];
  const row = map.objectRow[object];
  const { x, y, xx, yy, count, missing } = history.changes;
  return [
    ["seen", `${counted(count[row], "time")}${missing[row] ? ", missing now" : ""}`],
    ["at", `(${x[row].toFixed(2)}, ${y[row].toFixed(2)}) m${Number.isNaN(xx[row]) ? "" : `, ± ${Math.sqrt(Math.max(xx[row], yy[row])).toFixed(2)} m`}`],
    ["in", placeLink(history, map, placeNow(history, map, row))],
    ...floorFact(history, floorOfObject(history, object)),
  ];
}

function keyframeFacts(thing: store.Thing, history: History, map: MapState): Fact[] {
  const keyframe = findKeyframe(history, thing.id);
  if (keyframe < 0 || keyframe >= map.keyframeCount) return [["now", "not yet recorded"]];
  const { x, y, yaw } = history.keyframes;
  const pose = Number.isNaN(x[keyframe]) ? "none" : `(${x[keyframe].toFixed(2)}, ${y[keyframe].toFixed(2)}) m, facing ${Math.round((yaw[keyframe] * 180) / Math.PI)}°`;
  return [
    ["pose", pose],
    ["in", placeLink(history, map, map.placeOf[keyframe])],
    ...floorFact(history, history.keyframes.floor[keyframe]),
    ...(isSaved ? [] : [["ask", <button type="button" class="link" onClick={() => openPanel("lost")}>Where would a robot be that sees this?</button>] satisfies Fact]),
  ];
}
