/** Finds a place, object, class, detection or keyframe; `/` comes here. */

import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { address, getJson } from "../api/client";
import { bringIntoView } from "../map/MapCanvas";
import { keyframeId } from "../model/names";
import { type Hit, searchLocally } from "../model/search";
import { goTo, positionOf, select } from "../state/actions";
import * as store from "../state/store";
import { Icon } from "./icons";

const text = signal("");
const hits = signal<Hit[]>([]);
const active = signal(0);
const open = signal(false);
const ASK_AFTER_MS = 180;
let asking = new AbortController();

export function focusSearch() {
  document.querySelector<HTMLInputElement>("#search")?.focus();
}

export function Search() {
  const timer = useRef(0);
  useEffect(() => () => clearTimeout(timer.current), []);
  const change = (value: string) => {
    text.value = value;
    open.value = true;
    active.value = 0;
    const [history, map] = [store.history.value, store.map.value];
    hits.value = history === null || map === null ? [] : searchLocally(history, map, value);
    clearTimeout(timer.current);
    if (value.trim() !== "") timer.current = window.setTimeout(() => void askServer(value), ASK_AFTER_MS);
  };
  const choose = (hit: Hit | undefined) => {
    if (hit === undefined) return;
    open.value = false;
    if (hit.from !== null && store.at.value <= hit.from) goTo(hit.from + 1);
    select(hit.thing, true);
    const at = positionOf(hit.thing);
    if (at !== null) bringIntoView(...at);
    document.querySelector<HTMLInputElement>("#search")?.blur();
  };
  const key = (event: KeyboardEvent) => {
    const most = Math.max(0, hits.value.length - 1);
    if (event.key === "ArrowDown") active.value = Math.min(most, active.value + 1);
    else if (event.key === "ArrowUp") active.value = Math.max(0, active.value - 1);
    else if (event.key === "Enter") choose(hits.value[active.value]);
    else if (event.key === "Escape") {
      open.value = false;
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
        onBlur={() => (open.value = false)}
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
        {hits.value.length === 0 && <li class="none" role="option" aria-selected={false}>Nothing in this log has such a name.</li>}
      </ul>
    </div>
  );
}

interface ServerHit {
  kind: string;
  id: string;
  /** The row of the keyframe, for a detection. */
  number: number;
  text: string;
  offset: number;
}

/** The server knows what the page does not: det_ids. */
async function askServer(value: string) {
  asking.abort();
  asking = new AbortController();
  const [history, map] = [store.history.value, store.map.value];
  if (history === null || map === null) return;
  try {
    const answer = await getJson<{ found: ServerHit[] }>(address("/api/search", { q: value, kind: "detection", known_at: history.knownAt }), asking.signal);
    if (text.value !== value) return;
    const more = answer.found.map(({ id, number, text: says, offset }): Hit => ({
      thing: { kind: "keyframe", id: keyframeId(history, number) },
      title: id,
      more: says,
      from: number < map.keyframeCount ? null : offset,
    }));
    hits.value = [...hits.value, ...more].slice(0, 12);
  } catch {
    // The hits that the page found itself stay; the banner reports a lost server.
  }
}
