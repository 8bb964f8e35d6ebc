/** The event that made a condition over the map true. */

import { signal } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { ApiError, address, getJson } from "../api/client";
import { label } from "../model/names";
import { showEvent } from "../state/actions";
import { sentence } from "../state/loading";
import * as store from "../state/store";
import { type Completion, type ConditionFunction, completions, quoted } from "./completion";
import { CommandLine, Moment } from "./AnswerParts";

interface Turn {
  offset: number;
  becomes: boolean;
  time: string | null;
  before: Record<string, unknown>;
  after: Record<string, unknown>;
}

interface Search {
  found: Turn | null;
  turns: Turn[];
  holds_at_start: boolean;
  holds_at_end: boolean;
  maps_asked: number;
  lines: string[];
  command: string;
}

const text = store.condition;
const answer = signal<Search | null>(null);
const problem = signal<{ message: string; column: number | null } | null>(null);
const every = signal(false);

export function Find() {
  const [functions, setFunctions] = useState<ConditionFunction[]>([]);
  const [busy, setBusy] = useState(false);
  const [leaving] = useState(() => new AbortController());
  useEffect(() => {
    getJson<{ functions: ConditionFunction[] }>("/api/conditions", leaving.signal).then(
      (found) => setFunctions(found.functions),
      () => setFunctions([]),
    );
    return () => leaving.abort();
  }, []);
  useEffect(() => {
    store.foundAt.value = answer.value === null ? [] : turnsOf(answer.value);
    return () => {
      store.foundAt.value = [];
    };
  }, [answer.value]);
  useEffect(() => {
    if (text.value !== "" && answer.value === null) void ask(); // of a link
  }, []);
  const ask = async () => {
    const history = store.history.value;
    if (history === null) return;
    if (text.value.trim() === "") {
      problem.value = { message: "Write a condition, or click an example below.", column: null };
      return;
    }
    setBusy(true);
    try {
      const found = await getJson<Search>(address("/api/bisect", { condition: text.value, scan: every.value ? "1" : null, to: history.through, known_at: history.knownAt }), leaving.signal);
      answer.value = found;
      problem.value = null;
      if (found.found !== null) showEvent(found.found.offset);
    } catch (error) {
      if (leaving.signal.aborted) return;
      answer.value = null;
      problem.value = { message: sentence(error), column: error instanceof ApiError ? error.column : null };
    } finally {
      setBusy(false);
    }
  };
  return (
    <section class="story">
      <form
        onSubmit={(event) => {
          event.preventDefault();
          void ask();
        }}
      >
        <label for="condition">Condition over the map</label>
        <ConditionField functions={functions} />
        {problem.value !== null && <Problem />}
        <div class="form-row">
          <button class="button main" type="submit" disabled={busy}>
            {busy ? "Looking …" : "Find"}
          </button>
          <label class="check">
            <input type="checkbox" checked={every.value} onChange={() => (every.value = !every.value)} />
            every turn, not only the first
          </label>
        </div>
      </form>
      {answer.value === null ? <Examples functions={functions} run={(example) => { text.value = example; void ask(); }} /> : <Found found={answer.value} />}
    </section>
  );
}

function ConditionField({ functions }: { functions: readonly ConditionFunction[] }) {
  const ref = useRef<HTMLInputElement>(null);
  const [cursor, setCursor] = useState(0);
  const [open, setOpen] = useState(false);
  const [active, setActive] = useState(0);
  const history = store.history.value;
  const offered = open && history !== null ? completions(text.value, cursor, functions, history) : [];
  const choose = (each: Completion | undefined) => {
    const input = ref.current;
    if (each === undefined || input === null) return;
    const rest = text.value.slice(cursor).replace(/^['")]+/, "");
    text.value = text.value.slice(0, each.from) + each.insert + rest;
    const at = each.from + each.insert.length;
    setCursor(at);
    setActive(0);
    queueMicrotask(() => {
      input.value = text.value;
      input.setSelectionRange(at, at);
      input.focus();
    });
  };
  const key = (event: KeyboardEvent) => {
    if (offered.length === 0) return;
    if (event.key === "ArrowDown") setActive(Math.min(offered.length - 1, active + 1));
    else if (event.key === "ArrowUp") setActive(Math.max(0, active - 1));
    else if (event.key === "Tab" && !event.shiftKey) choose(offered[active]);
    else if (event.key === "Escape") setOpen(false);
    else return;
    event.preventDefault();
    event.stopPropagation();
  };
  const look = (input: HTMLInputElement) => {
    text.value = input.value;
    problem.value = null;
    setCursor(input.selectionStart ?? input.value.length);
    setOpen(true);
    setActive(0);
  };
  return (
    <div class="condition">
      <input
        ref={ref}
        id="condition"
        type="text"
        spellcheck={false}
        autoComplete="off"
        placeholder="place_count() < 6"
        role="combobox"
        aria-expanded={offered.length > 0}
        aria-controls="completions"
        aria-autocomplete="list"
        aria-activedescendant={offered.length > 0 ? `completion-${active}` : undefined}
        aria-invalid={problem.value !== null}
        aria-describedby={problem.value === null ? undefined : "condition-problem"}
        value={text.value}
        onInput={(event) => look(event.currentTarget)}
        onClick={(event) => setCursor(event.currentTarget.selectionStart ?? 0)}
        onFocus={() => setOpen(true)}
        onBlur={() => setOpen(false)}
        onKeyDown={key}
      />
      <ul id="completions" role="listbox" aria-label="Completions" hidden={offered.length === 0}>
        {offered.map((each, index) => (
          <li
            key={each.title}
            id={`completion-${index}`}
            role="option"
            aria-selected={index === active}
            onPointerDown={(event) => {
              event.preventDefault();
              choose(each);
            }}
          >
            <bdi>{each.title}</bdi>
            <span class="dim">{each.says}</span>
          </li>
        ))}
        {offered.length > 0 && <li class="hint" role="presentation">Tab takes the marked one</li>}
      </ul>
    </div>
  );
}

/** The condition again, with a sign below the column that is wrong. */
function Problem() {
  const { message, column } = problem.value as { message: string; column: number | null };
  return (
    <div id="condition-problem" class="error" role="alert">
      {column !== null && <pre class="pointer" aria-hidden="true">{`${text.value}\n${" ".repeat(Math.max(0, column - 1))}^`}</pre>}
      <p>{message}</p>
    </div>
  );
}

function turnsOf({ found, turns }: Search): Turn[] {
  return turns.length > 0 || found === null ? turns : [found];
}

function Found({ found }: { found: Search }) {
  const turns = turnsOf(found);
  return (
    <div class="answer">
      <p class="summary">
        {found.found !== null ? (
          <>
            Became true by event <Moment offset={found.found.offset} />.
          </>
        ) : found.holds_at_start ? (
          "True from the beginning on."
        ) : (
          "Never true in this log."
        )}{" "}
        <span class="dim">{found.maps_asked.toLocaleString("en")} maps asked</span>
      </p>
      {turns.length > 0 && (
        <ol class="steps">
          {turns.slice(0, 200).map((turn) => (
            <li key={turn.offset}>
              <Moment offset={turn.offset} />
              <div>
                <p>
                  <b class={turn.becomes ? "yes" : "no"}>{turn.becomes ? "true" : "false"}</b> {readings(turn)}
                </p>
                {turn.time !== null && <time>{turn.time.replace("T", " ").replace("Z", "")}</time>}
              </div>
            </li>
          ))}
        </ol>
      )}
      <CommandLine command={found.command} />
    </div>
  );
}

function readings({ before, after }: Turn): string {
  const value = (each: unknown) => (each === null || each === undefined ? "none" : label(String(each), 60));
  return Object.keys(after)
    .map((name) => `${name}: ${value(before[name])} → ${value(after[name])}`)
    .join(", ");
}

function Examples({ functions, run }: { functions: readonly ConditionFunction[]; run: (example: string) => void }) {
  const history = store.history.value;
  if (history === null) return null;
  const place = history.placeIds[0];
  const examples = [
    `place_count() == ${Math.max(1, store.map.value?.places.length ?? 1)}`,
    ...(place === undefined ? [] : [`size(${quoted(place)}) > 50`]),
    ...(history.placeIds.length > 1 ? [`merged(${quoted(history.placeIds[history.merges.absorbed[0] ?? 1])})`] : []),
    "object_count() >= 10",
  ];
  return (
    <>
      <h2>Examples</h2>
      <ul class="examples">
        {examples.map((each) => (
          <li key={each}>
            <button type="button" class="link" title="Find the event that made it true" onClick={() => run(each)}>
              <code>{each}</code>
            </button>
          </li>
        ))}
      </ul>
      <h2>Functions of conditions</h2>
      <dl class="functions">
        {functions.map(({ name, signature, says }) => (
          <div key={name}>
            <dt>
              <code>{signature}</code>
            </dt>
            <dd>{says}</dd>
          </div>
        ))}
      </dl>
    </>
  );
}
