/** Another ε and number of neighbours: the log is folded again, and two maps are shown. */

import { batch } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { address, getBinary } from "../api/client";
import { decodeHistory } from "../history/decode";
import { useAnswer } from "../state/answers";
import { sentence } from "../state/loading";
import * as store from "../state/store";
import { Answer, CommandLine, Moment } from "./AnswerParts";

const FOLD_AFTER_MS = 220;

interface Alternative {
  places: number;
  noise: number;
  merges: number;
  objects: number;
  same: boolean;
  places_adjusted_rand: number;
  places_part_at: number | null;
  objects_part_at: number | null;
  truth: Record<string, number> | null;
}

interface WhatIfAnswer {
  base: Alternative;
  alternatives: Alternative[];
  lines: string[];
  seconds: number;
  command: string;
}

export function CompareSettings() {
  const own = store.log.value?.settings as Record<string, number> | undefined;
  const [took, setTook] = useState<{ fold: number; whole: number } | null>(null);
  const [failed, setFailed] = useState<string | null>(null);
  const [folding, setFolding] = useState(false);
  const eps = store.otherEps.value ?? own?.["eps_m"] ?? 1;
  const neighbours = store.otherMinSamples.value ?? own?.["min_samples"] ?? 3;
  const through = store.history.value?.through ?? 0;
  const byRooms = store.log.value?.places_rule === "rooms";
  const trial = { eps_m: eps, min_samples: neighbours, set: byRooms ? "places=page" : null };
  const chosen = store.otherEps.value !== null || store.otherMinSamples.value !== null;

  useEffect(() => {
    if (!chosen) {
      store.otherHistory.value = null;
      return undefined;
    }
    const abort = new AbortController();
    const timer = window.setTimeout(() => {
      const start = performance.now();
      setFolding(true);
      getBinary(address("/api/history", { ...trial, known_at: store.shownKnownAt.value }), abort.signal)
        .then((answer) => {
          const history = decodeHistory(answer);
          batch(() => {
            store.otherHistory.value = history;
          });
          setTook({ fold: history.refoldMs, whole: performance.now() - start });
          setFailed(null);
          setFolding(false);
        })
        .catch((error: unknown) => {
          if (abort.signal.aborted) return;
          setFailed(sentence(error));
          setFolding(false);
        });
    }, FOLD_AFTER_MS);
    return () => {
      clearTimeout(timer);
      abort.abort();
    };
  }, [eps, neighbours, chosen, through, store.shownKnownAt.value]);
  useEffect(() => () => {
    store.otherHistory.value = null;
  }, []);

  const other = store.otherHistory.value;
  const folded = other?.settings as Record<string, number> | undefined;
  const current = folded !== undefined && folded["eps_m"] === eps && folded["min_samples"] === neighbours;
  const path = current && chosen ? address("/api/whatif", { ...trial, known_at: store.shownKnownAt.value }) : null;
  const asked = useAnswer<WhatIfAnswer>(path, through);
  return (
    <>
      <Slider name="ε, metres" value={eps} own={own?.["eps_m"]} least={0.1} most={Math.max(3, (own?.["eps_m"] ?? 1) * 2)} step={0.05} onChange={(value) => (store.otherEps.value = value)} />
      <Slider name="Neighbours of a core point" value={neighbours} own={own?.["min_samples"]} least={1} most={Math.max(30, (own?.["min_samples"] ?? 3) * 2)} step={1} onChange={(value) => (store.otherMinSamples.value = value)} />
      {byRooms && <p class="note">This log’s places are by rooms. With ε and neighbours they are by density (places=page).</p>}
      {!chosen && <p class="dim">Move a slider: the log is folded again under the other settings, and both maps are shown side by side with one view and one timeline.</p>}
      {chosen && (
        <p class="summary" role="status">
          {folding ? "Folding …" : took !== null && `Folded in ${took.fold.toFixed(0)} ms, shown after ${took.whole.toFixed(0)} ms.`}{" "}
          <button type="button" class="link" onClick={() => batch(() => { store.otherEps.value = null; store.otherMinSamples.value = null; })}>
            Back to the log’s settings
          </button>
        </p>
      )}
      {failed !== null && <p class="error" role="alert">{failed}</p>}
      <Answer asked={asked}>{(answer) => <Scores answer={answer} />}</Answer>
    </>
  );
}

function Slider({ name, value, own, least, most, step, onChange }: { name: string; value: number; own: number | undefined; least: number; most: number; step: number; onChange: (value: number) => void }) {
  return (
    <div class="slider">
      <span aria-hidden="true">
        {name} <b>{value}</b> {own !== undefined && own !== value && <span class="dim">log: {own}</span>}
      </span>
      <input type="range" aria-label={name} min={least} max={most} step={step} value={value} onInput={(event) => onChange(Number(event.currentTarget.value))} />
    </div>
  );
}

function Scores({ answer }: { answer: WhatIfAnswer }) {
  const other = answer.alternatives[0];
  if (other === undefined) return null;
  const parts = other.places_part_at;
  const rows: [string, (each: Alternative) => number | string][] = [
    ["places", (each) => each.places],
    ["in no place", (each) => each.noise],
    ["merges", (each) => each.merges],
    ["objects", (each) => each.objects],
    ...Object.keys(other.truth ?? {}).map((name): [string, (each: Alternative) => string] => [name.replaceAll("_", " "), (each) => (each.truth?.[name] ?? Number.NaN).toFixed(3)]),
  ];
  return (
    <>
      <p class="summary">
        {other.same ? "The map at the end is the same." : parts === null ? "The places are the same, the objects are not." : <>The places differ from event <Moment offset={parts} /> on.</>}
      </p>
      <table>
        <thead>
          <tr>
            <td />
            <th scope="col">as recorded</th>
            <th scope="col">what if</th>
          </tr>
        </thead>
        <tbody>
          {rows.map(([name, of]) => (
            <tr key={name}>
              <th scope="row">{name}</th>
              <td>{of(answer.base)}</td>
              <td>{of(other)}</td>
            </tr>
          ))}
          <tr>
            <th scope="row">agreement of places (ARI)</th>
            <td />
            <td>{other.places_adjusted_rand.toFixed(3)}</td>
          </tr>
        </tbody>
      </table>
      <pre class="lines" tabIndex={0} aria-label="Answer as text">{answer.lines.join("\n")}</pre>
      <CommandLine command={answer.command} />
    </>
  );
}
