/** Corrections: the list with undo, and a form with a preview and a reason. */

import { signal } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { hasToken, postJson } from "../api/client";
import { label } from "../model/names";
import { useAnswer } from "../state/answers";
import { grow, sentence } from "../state/loading";
import { showNotice } from "../state/pointer";
import * as store from "../state/store";
import { byDragging } from "./drag_edits";
import { type Parameter, KINDS, previewed, proposal, propose, proposed } from "./proposals";
import { Answer, CommandLine, Moment } from "./AnswerParts";

interface Correction {
  offset: number;
  kind: string;
  what: string;
  reason: string;
  issued_by: string;
  command_id: string;
  undone_by: string | null;
  repeats?: number;
  time: string | null;
}

interface Outcome {
  lines?: string[];
  offset?: number | null;
  command_id?: string;
  effect_text?: string | null;
  notes?: string[];
  command?: string;
}

const recorded = signal(0);

export function Correct() {
  const history = store.history.value;
  const asked = useAnswer<{ corrections: Correction[]; command: string }>(history === null ? null : "/api/corrections", `${history?.through} ${recorded.value}`);
  const allowed = store.log.value?.edits_allowed ?? false;
  return (
    <section class="story">
      {allowed && !hasToken && <p class="error" role="alert">This page was opened without the token of the printed link, so it cannot record corrections. Open the link that mapfold ui printed.</p>}
      {allowed ? <Form /> : <p class="note">This page is read-only. To record corrections, start it with <code>mapfold ui LOG --allow-edits</code>.</p>}
      <h2>Corrections in this log</h2>
      <Answer asked={asked}>
        {({ corrections, command }) => (
          <>
            {corrections.length === 0 && <p class="dim">None.</p>}
            <ol class="corrections">
              {corrections.map((each) => (
                <li key={each.offset} class={each.undone_by !== null || each.repeats !== undefined ? "undone" : ""}>
                  <Moment offset={each.offset} />
                  <div>
                    <p>
                      <b>{each.kind}</b> <bdi>{label(each.what, 120)}</bdi>
                    </p>
                    <p class="dim">
                      <bdi>{label(each.issued_by, 60)}</bdi>{each.reason !== "" && <>: <bdi>{label(each.reason, 300)}</bdi></>}
                    </p>
                    {each.undone_by !== null && <p class="dim">undone by <bdi>{label(each.undone_by, 40)}</bdi></p>}
                    {each.repeats !== undefined && <p class="dim">not counted: {each.repeats} has the same id</p>}
                  </div>
                  {allowed && each.undone_by === null && each.repeats === undefined && (
                    <button type="button" class="button quiet" onClick={() => propose({ kind: "undo", arguments: [each.command_id] })}>
                      Undo
                    </button>
                  )}
                </li>
              ))}
            </ol>
            <CommandLine command={command} />
          </>
        )}
      </Answer>
    </section>
  );
}

/** For how many proposals the form has taken the focus. */
let focused = 0;

function Form() {
  const wanted = proposal.value ?? { kind: "name-place", arguments: [] };
  const kind = KINDS[wanted.kind];
  const [reason, setReason] = useState("");
  const [preview, setPreview] = useState<Outcome | null>(null);
  const [failed, setFailed] = useState<string | null>(null);
  const [busy, setBusy] = useState(false);
  /** The command that was recorded last, to be undone. */
  const [done, setDone] = useState<string | null>(null);
  const given = kind.parameters.map((_, index) => wanted.arguments[index] ?? "");
  const key = JSON.stringify(wanted);
  const id = useRef("");
  useEffect(() => {
    id.current = Array.from(crypto.getRandomValues(new Uint8Array(16)), (each) => each.toString(16).padStart(2, "0")).join("");
    setPreview(null);
    setFailed(null);
  }, [key]);
  const form = useRef<HTMLFormElement>(null);
  const asked = proposed.value;
  useEffect(() => {
    if (asked === focused) return;
    focused = asked;
    const fields = [...(form.current?.querySelectorAll<HTMLInputElement>("input[type=text]") ?? [])];
    if (previewed.value) void send(true);
    else (fields.find((each) => each.value === "") ?? fields[0])?.focus();
    previewed.value = false;
  }, [asked]);
  const needsReason = !["name-place", "relabel"].includes(wanted.kind);
  const whole = given.every((each) => each.trim() !== "");
  const set = (index: number, value: string) => {
    proposal.value = { kind: wanted.kind, arguments: given.map((each, at) => (at === index ? value : each)) };
  };
  const send = async (dry: boolean) => {
    setDone(null);
    setBusy(true);
    setFailed(null);
    try {
      const outcome = await postJson<Outcome>("/api/edit", {
        kind: wanted.kind,
        arguments: given,
        reason,
        dry_run: dry,
        command_id: id.current, // recorded once, also when its answer is lost and it is sent again
      });
      if (dry) setPreview(outcome);
      else {
        showNotice(`Recorded at offset ${outcome.offset}. It changes ${outcome.effect_text ?? "the map"}.`);
        setDone(wanted.kind === "undo" ? null : (outcome.command_id ?? null));
        proposal.value = null;
        setReason("");
        setPreview(null);
        await grow();
        recorded.value++;
      }
    } catch (error) {
      setFailed(sentence(error));
    } finally {
      setBusy(false);
    }
  };
  const undo = async (command: string) => {
    setBusy(true);
    try {
      await postJson<Outcome>("/api/edit", { kind: "undo", arguments: [command], reason: "a mistake, undone in the page", dry_run: false });
      setDone(null);
      showNotice("Undone.");
      await grow();
      recorded.value++;
    } catch (error) {
      setFailed(sentence(error));
    } finally {
      setBusy(false);
    }
  };
  return (
    <form
      ref={form}
      class="correction"
      onSubmit={(event) => {
        event.preventDefault();
        void send(preview === null && needsReason);
      }}
    >
      <label class="check" title="Anywhere else a drag moves the view">
        <input type="checkbox" checked={byDragging.value} onChange={() => (byDragging.value = !byDragging.value)} />
        <span>Correct by dragging on the map: a place onto another joins them, within one cuts it; an object onto another makes them one, or gives its class the other’s name</span>
      </label>
      <label for="correction-kind">
        Correction
        <select id="correction-kind" value={wanted.kind} onChange={(event) => (proposal.value = { kind: event.currentTarget.value, arguments: sameKind(wanted, event.currentTarget.value) })}>
          {Object.entries(KINDS).map(([name, { says }]) => (
            <option key={name} value={name}>
              {says}
            </option>
          ))}
        </select>
      </label>
      {kind.parameters.map((parameter, index) => (
        <ParameterField key={`${wanted.kind} ${parameter.name}`} parameter={parameter} value={given[index]} onChange={(value) => set(index, value)} />
      ))}
      {preview !== null && needsReason && (
        <label>
          Reason
          <input type="text" maxLength={2000} required value={reason} placeholder="Why is it so?" onInput={(event) => setReason(event.currentTarget.value)} />
        </label>
      )}
      {failed !== null && <p class="error" role="alert">{failed}</p>}
      {preview !== null && (
        <div class="preview" role="status">
          <b>Would change {preview.effect_text ?? "the map"}</b>
          {preview.notes?.map((note) => <p key={note} class="note">{note}</p>)}
          <pre class="lines" tabIndex={0} aria-label="What would change">{(preview.lines ?? []).join("\n")}</pre>
        </div>
      )}
      {preview !== null && <CommandLine command={preview.command} />}
      <div class="form-row">
        {preview === null ? (
          <>
            {!needsReason && (
              <button class="button main" type="submit" disabled={busy || !whole}>
                {busy ? "Recording …" : "Record it"}
              </button>
            )}
            <button class={needsReason ? "button main" : "button quiet"} type={needsReason ? "submit" : "button"} disabled={busy || !whole} onClick={() => needsReason || void send(true)}>
              {busy && needsReason ? "Folding …" : "Preview"}
            </button>
            {done !== null && (
              <button class="button quiet" type="button" title="Undo what was just recorded" disabled={busy} onClick={() => void undo(done)}>
                Undo it
              </button>
            )}
          </>
        ) : (
          <>
            <button class="button main" type="submit" disabled={busy || (needsReason && reason.trim() === "")}>
              {busy ? "Recording …" : "Record it"}
            </button>
            <button class="button quiet" type="button" onClick={() => setPreview(null)}>
              Back
            </button>
          </>
        )}
      </div>
    </form>
  );
}

/** Arguments that another kind of correction takes too. */
function sameKind(wanted: { kind: string; arguments: string[] }, next: string): string[] {
  const [from, to] = [KINDS[wanted.kind], KINDS[next]];
  return to.parameters.map(({ takes }, index) => (from.parameters[index]?.takes === takes ? (wanted.arguments[index] ?? "") : ""));
}

function ParameterField({ parameter, value, onChange }: { parameter: Parameter; value: string; onChange: (value: string) => void }) {
  const history = store.history.value;
  const map = store.map.value;
  const names =
    history === null || map === null
      ? []
      : parameter.takes === "place"
        ? map.places.map((place) => history.placeIds[place])
        : parameter.takes === "object"
          ? map.objects.map((object) => history.objectIds[object])
          : parameter.takes === "run"
            ? history.runIds
            : parameter.takes === "offset"
              ? [...new Set(history.merges.offset)].map(String)
              : [];
  const list = `names-${parameter.name.replace(/\W/g, "-")}`;
  const thing = store.selection.value;
  const fits = thing !== null && thing.id !== value && (thing.kind === parameter.takes || (thing.kind === "merge" && parameter.takes === "offset"));
  return (
    <label>
      {parameter.name}
      <span class="form-row">
        <input type="text" list={names.length > 0 ? list : undefined} spellcheck={false} autoComplete="off" value={value} onInput={(event) => onChange(event.currentTarget.value)} />
        {fits && (
          <button type="button" class="button quiet" title={`Take ${thing.id}`} onClick={() => onChange(thing.id)}>
            Take selected
          </button>
        )}
      </span>
      {names.length > 0 && (
        <datalist id={list}>
          {names.slice(0, 500).map((name) => (
            <option key={name} value={name} />
          ))}
        </datalist>
      )}
    </label>
  );
}
