/** Parts that several panels are made of: states of an answer, steps, links to things. */

import type { ComponentChildren } from "preact";
import type { MapChange, Ref, Step } from "../api/types";
import type { History } from "../history/types";
import { bringIntoView } from "../map/MapCanvas";
import { findPlace, isolated, keyframeTitle, label, shortObject, shortPlace } from "../model/names";
import { positionOf, select, showEvent } from "../state/actions";
import type { Asked } from "../state/answers";
import { showNotice } from "../state/pointer";
import * as store from "../state/store";
import { Icon } from "../ui/icons";

const KINDS: readonly string[] = ["place", "object", "keyframe", "merge"];

/** The answer, or a sentence about why there is none. */
export function Answer<T>({ asked, children }: { asked: Asked<T>; children: (value: T) => ComponentChildren }) {
  if (asked.error !== null) return <p class="answer error" role="alert">{asked.error.message}</p>;
  if (asked.value === null) return asked.loading ? <p class="answer dim" role="status">Asking …</p> : null;
  return <div class={asked.loading ? "answer stale" : "answer"} aria-busy={asked.loading}>{children(asked.value)}</div>;
}

/** A thing that can be clicked: it is selected, and brought into view. */
export function ThingLink({ thing, children }: { thing: store.Thing; children?: ComponentChildren }) {
  const go = () => {
    if (thing.kind === "merge") showEvent(Number(thing.id));
    select(thing, true);
    const at = positionOf(thing);
    if (at !== null) bringIntoView(...at);
  };
  return (
    <button
      type="button"
      class="link"
      onClick={go}
      onMouseEnter={() => (store.hovered.value = thing)}
      onMouseLeave={() => (store.hovered.value = null)}
    >
      <bdi>{children ?? label(shortName(thing), 40)}</bdi>
    </button>
  );
}

/** What the map and commands call a thing. */
function shortName({ kind, id }: store.Thing): string {
  const history = store.history.value;
  if (kind === "keyframe") return keyframeTitle(id);
  if (kind === "object") return shortObject(id);
  const place = kind === "place" && history !== null ? findPlace(history, id) : -1;
  return history === null || place < 0 ? id : shortPlace(history, place);
}

/** The moment after an event, to click. */
export function Moment({ offset }: { offset: number }) {
  const now = store.at.value === offset + 1;
  return (
    <button type="button" class={now ? "moment-link now" : "moment-link"} aria-current={now ? "step" : undefined} title="Show the map after this event" onClick={() => showEvent(offset)}>
      {offset}
    </button>
  );
}

export function Steps({ steps }: { steps: readonly Step[] }) {
  return (
    <ol class="steps">
      {steps.map((step, index) => (
        <li key={index} class={step.offset < store.at.value ? "past" : "ahead"}>
          <Moment offset={step.offset} />
          <div>
            <p>
              <Linked text={step.text} refs={step.refs ?? []} />
            </p>
            {step.refs?.filter(({ kind }) => kind === "merge").map(({ id }) => (
              <p key={id}>
                <ThingLink thing={{ kind: "merge", id }}>see the merge</ThingLink>
              </p>
            ))}
            {step.time !== undefined && step.time !== null && <time>{step.time.replace("T", " ").replace("Z", "")}</time>}
          </div>
        </li>
      ))}
    </ol>
  );
}

const CHANGES = {
  moved: ["→", "moved"],
  missing: ["×", "missing"],
  new: ["+", "new"],
  back: ["↺", "back"],
} as const;

/** What became of an object, in a line; `changes` has the whole sentence. */
export function ChangeLine({ change, history, id, current }: { change: MapChange; history: History; id?: string; current?: boolean }) {
  const [sign, says] = CHANGES[change.kind];
  const place = change.place_id === null ? -1 : findPlace(history, change.place_id);
  const where = change.place_name ?? change.place_type ?? (place < 0 ? "in no place" : shortPlace(history, place));
  return (
    <li id={id} class={current ? "now" : undefined} aria-current={current ? "true" : undefined} title={label(change.sentence, 300)}>
      <span class={`sign-${change.kind}`} aria-hidden="true">{sign}</span>
      <p>
        <ThingLink thing={{ kind: "object", id: change.object_id }}>{label(change.class_name, 28)}</ThingLink> {says}
        {change.moved_m !== null && ` ${change.moved_m.toFixed(1)} m`}, <span class="dim"><bdi>{label(where, 28)}</bdi>, {shortTime(change.seen.iso, history)}</span>
      </p>
    </li>
  );
}

const sameDay = new WeakMap<History, boolean>();

/** `13:05` where all of the log is of one day, else `24 Mar 13:05`. */
export function shortTime(iso: string, history: History): string {
  let one = sameDay.get(history);
  if (one === undefined) {
    const { stamp } = history.keyframes;
    one = stamp.every((each) => Math.floor(each / 86_400) === Math.floor(stamp[0] / 86_400));
    sameDay.set(history, one);
  }
  const clock = iso.slice(11, 16);
  if (one) return clock;
  const date = new Date(iso);
  return `${date.getUTCDate()} ${date.toLocaleString("en", { month: "short", timeZone: "UTC" })} ${clock}`;
}

/** A sentence in which the things it names can be clicked. */
export function Linked({ text, refs }: { text: string; refs: readonly Ref[] }) {
  const names = new Map<string, store.Thing>();
  for (const { kind, id, name } of refs) {
    if (!KINDS.includes(kind) || kind === "merge" || id === "") continue;
    const thing = { kind, id } as store.Thing;
    names.set(id, thing);
    if (name !== undefined) names.set(name, thing);
    if (kind === "keyframe") names.set(keyframeTitle(id), thing);
  }
  const parts: ComponentChildren[] = [];
  let rest = text;
  while (rest !== "") {
    const next = firstName(rest, names);
    if (next === null) break;
    parts.push(rest.slice(0, next.at), <ThingLink thing={next.thing}>{label(next.name === next.thing.id ? shortName(next.thing) : next.name, 60)}</ThingLink>);
    rest = rest.slice(next.at + next.name.length);
  }
  return (
    <>
      {parts}
      {rest}
    </>
  );
}

function firstName(text: string, names: ReadonlyMap<string, store.Thing>) {
  let found: { at: number; name: string; thing: store.Thing } | null = null;
  for (const [name, thing] of names) {
    let at = text.indexOf(name);
    while (at >= 0 && /\w/.test(`${text[at - 1] ?? ""}${text[at + name.length] ?? ""}`)) at = text.indexOf(name, at + 1);
    if (at < 0) continue;
    if (found === null || at < found.at || (at === found.at && name.length > found.name.length)) found = { at, name, thing };
  }
  return found;
}

/** The command line that gives the same answer, to copy. */
export function CommandLine({ command }: { command: string | null | undefined }) {
  if (command === null || command === undefined) return null;
  return (
    <div class="command">
      <code tabIndex={0} aria-label="Command line of this answer">{command}</code>
      <button type="button" class="icon" aria-label="Copy as command" title="Copy as command" onClick={() => void copy(command, "the command line")}>
        <Icon name="copy" />
      </button>
    </div>
  );
}

export async function copy(text: string, what: string) {
  try {
    await navigator.clipboard.writeText(text);
    showNotice(`Copied ${what}.`);
  } catch {
    showNotice(`The browser does not let this page copy. Here it is: ${text}`);
  }
}

export function Lines({ lines }: { lines: readonly string[] }) {
  return <pre class="lines" tabIndex={0} aria-label="Answer as text">{lines.map((line) => isolated(line)).join("\n")}</pre>;
}
