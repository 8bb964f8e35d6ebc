/** Finds a place, object, class, detection or keyframe; `/` comes here. Objects are what `mapfold
 * find` answers. What is found is marked on the map, arrow keys go through it. */

import { batch, effect, signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { ApiError, address, getJson } from "../api/client";
import { isSaved } from "../api/saved";
import type { FoundObjects, NamedThing } from "../api/types";
import { bringIntoView } from "../map/MapCanvas";
import { label } from "../model/names";
import { type Hit, foundHit, namedHit, searchLocally } from "../model/search";
import { goTo, positionOf, select } from "../state/actions";
import * as store from "../state/store";
import { Icon } from "./icons";

const text = signal("");
const hits = signal<Hit[]>([]);
const active = signal(0);
const open = signal(false);
/** What the server says about the answers, or why there are none. */
const remark = signal<string | null>(null);
const ASK_AFTER_MS = 180;
const MOST_OBJECTS = 20;
const MOST_NAMED = 12;
let asking = new AbortController();
/** Whether Enter was pressed before there was something to choose. */
let chosenEarly = false;

export function focusSearch() {
  document.querySelector<HTMLInputElement>("#search")?.focus();
}

export function Search() {
  const timer = useRef(0);
  useEffect(() => () => clearTimeout(timer.current), []);
  useEffect(
    () =>
      effect(() => {
        const listed = open.value ? hits.value : [];
        const marked = store.found.peek().length > 0;
        store.found.value = listed.map(({ thing }) => thing);
        if (marked || listed.length > 0) store.hovered.value = listed[active.value]?.thing ?? null;
      }),
    [],
  );
  const change = (value: string) => {
    const [history, map] = [store.history.value, store.map.value];
    asking.abort();
    clearTimeout(timer.current);
    chosenEarly = false;
    batch(() => {
      text.value = value;
      open.value = true;
      active.value = 0;
      remark.value = value.trim() === "" ? null : "…";
      hits.value = history === null || map === null ? [] : searchLocally(history, map, store.rooms.value, value);
    });
    if (value.trim() !== "") timer.current = window.setTimeout(() => void askServer(value), ASK_AFTER_MS);
  };
  const key = (event: KeyboardEvent) => {
    if (event.key === "ArrowDown") walk(1);
    else if (event.key === "ArrowUp") walk(-1);
    else if (event.key === "Enter") {
      chosenEarly = hits.value.length === 0;
      choose(hits.value[active.value]);
    } else if (event.key === "Escape") {
      close();
      (event.currentTarget as HTMLInputElement).blur();
    } else return;
    event.preventDefault();
    event.stopPropagation();
  };
  const shown = open.value && text.value.trim() !== "";
  return (
    <div class="search">
      <Icon name="search" />
      <input
        id="search"
        type="text"
        autoComplete="off"
        spellcheck={false}
        placeholder="Search: chair, p3, run:12"
        role="combobox"
        aria-label="Search places, objects, classes, detections and keyframes"
        aria-expanded={shown}
        aria-controls="hits"
        aria-autocomplete="list"
        aria-activedescendant={shown && hits.value.length > 0 ? `hit-${active.value}` : undefined}
        value={text.value}
        onInput={(event) => change(event.currentTarget.value)}
        onFocus={() => (open.value = true)}
        onBlur={close}
        onKeyDown={key}
      />
      <kbd aria-hidden="true">/</kbd>
      <ul id="hits" role="listbox" aria-label="Found" hidden={!shown}>
        {hits.value.map((hit, index) => (
          <li
            key={`${hit.title} ${hit.thing.id}`}
            id={`hit-${index}`}
            role="option"
            aria-selected={index === active.value}
            onPointerDown={(event) => {
              event.preventDefault();
              choose(hit);
            }}
          >
            <span class="kind">{hit.thing.kind}</span>
            <bdi class="what">{hit.title}</bdi>
            <bdi class="more">{hit.more}</bdi>
          </li>
        ))}
        {remark.value !== null && <li class="none" role="option" aria-selected={false}>{remark.value}</li>}
      </ul>
    </div>
  );
}

function close() {
  open.value = false;
}

function choose(hit: Hit | undefined) {
  if (hit === undefined) return;
  close();
  if (hit.from !== null && store.at.value <= hit.from) goTo(hit.from + 1);
  select(hit.thing, true);
  show(hit);
  document.querySelector<HTMLInputElement>("#search")?.blur();
}

function show({ thing }: Hit) {
  const at = positionOf(thing);
  if (at !== null) bringIntoView(...at);
}

/** To the next or the last one before, which the map then shows. */
function walk(step: 1 | -1) {
  const next = Math.max(0, Math.min(hits.value.length - 1, active.value + step));
  active.value = next;
  const hit = hits.value[next];
  if (hit !== undefined) show(hit);
  document.querySelector(`#hit-${next}`)?.scrollIntoView({ block: "nearest" });
}

/** What the page does not know: the Objects that are meant, things that are not there yet, det_ids. */
async function askServer(value: string) {
  asking = new AbortController();
  const { signal: left } = asking;
  const [history, map, at] = [store.history.value, store.map.value, store.at.value];
  if (history === null || map === null) return;
  if (isSaved) {
    const { answers } = await getJson<FoundObjects>(address("/api/find", { all: 1, at }));
    const alike = answers.filter(({ class_name, object_id }) => `${class_name} ${object_id}`.toLowerCase().includes(value.trim().toLowerCase()));
    hits.value = [...searchLocally(history, map, store.rooms.value, value), ...alike.slice(0, MOST_OBJECTS).map((each) => foundHit(history, each))];
    remark.value = hits.value.length > 0 ? null : "No name in this saved page has that text";
    if (chosenEarly) choose(hits.value[0]);
    return;
  }
  const moment = { at, known_at: store.knownAt(at) };
  const [objects, named] = await Promise.allSettled([
    getJson<FoundObjects>(address("/api/find", { what: value.trim(), top: MOST_OBJECTS, ...moment }), left),
    getJson<{ found: NamedThing[] }>(address("/api/search", { q: value, ...moment }), left),
  ]);
  if (left.aborted) return;
  const local = searchLocally(history, map, store.rooms.value, value);
  const answers = objects.status === "fulfilled" ? objects.value.answers.map((each) => foundHit(history, each)) : [];
  const unfound = named.status === "rejected" ? [] : named.value.found.filter(({ kind, stands }) => kind !== "object" || !stands || answers.length === 0);
  const others = unfound.map((each) => namedHit(history, map, each));
  const listed = [...local, ...answers];
  const key = ({ thing: { kind, id }, title }: Hit) => (kind === "keyframe" ? title : `${kind} ${id}`);
  const known = new Set(listed.map(key));
  const more = others.filter((each) => each !== null).filter((each) => !known.has(key(each)));
  batch(() => {
    hits.value = [...listed, ...more.slice(0, MOST_NAMED)];
    remark.value = remarkOn(value, objects, hits.value.length);
  });
  if (chosenEarly) choose(hits.value[0]);
}

function remarkOn(value: string, objects: PromiseSettledResult<FoundObjects>, count: number): string | null {
  if (objects.status === "rejected") {
    const refused = objects.reason instanceof ApiError && objects.reason.kind === "bad_question";
    return refused && count > 0 ? null : `${objects.reason instanceof Error ? objects.reason.message : objects.reason}`;
  }
  const { match, classes, count: all, answers, unconfirmed } = objects.value;
  const said = match === "words" || match === "spelling" ? [`no class “${value.trim()}”; found ${classes.map((each) => label(each)).join(", ")}`] : [];
  if (all > answers.length) said.push(`${(all - answers.length).toLocaleString("en")} more`);
  if (unconfirmed > 0) said.push(`+ ${unconfirmed.toLocaleString("en")} seen once`);
  return said.length === 0 ? null : said.join(" · ");
}
