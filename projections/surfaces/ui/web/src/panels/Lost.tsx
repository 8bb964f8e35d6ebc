/** Where a robot is that sees some things: asked with a keyframe, or with a question in a file. */

import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { address, getJson, postJson } from "../api/client";
import { findKeyframe, findPlace, isolated, keyframeId, label } from "../model/names";
import { goTo } from "../state/actions";
import { sentence } from "../state/loading";
import { lostOverlay } from "../state/overlays";
import * as store from "../state/store";
import { type LostAnswer, type Truth, overlayOf } from "./lost_answer";
import { CommandLine, ThingLink } from "./AnswerParts";

/** As the server takes. */
const MOST_BYTES = 1_000_000;

const keyframe = signal("");
const question = signal<{ name: string; text: string } | null>(null);
const answer = signal<LostAnswer | null>(null);
const truth = signal<Truth | null>(null);
/** Whether to ask the map as it was before it knew the keyframe's run. */
const before = signal(true);
const failed = signal<string | null>(null);
/** Which question is the newest: the answers of others are not shown. */
let newest = 0;

interface QuestionAnswer {
  question: unknown;
  truth: [number, number, number] | null;
  ask_at: number;
  number: number;
}

export function Lost() {
  const history = store.history.value;
  const [busy, setBusy] = useState(false);
  const [over, setOver] = useState(false);
  useEffect(() => {
    const thing = store.selection.peek();
    if (thing?.kind === "keyframe") keyframe.value = thing.id;
    else if (keyframe.value === "" && history !== null && history.keyframes.offset.length > 0) {
      keyframe.value = keyframeId(history, Math.floor(history.keyframes.offset.length / 2));
    }
  }, [store.selection.value?.id]);
  useEffect(() => {
    lostOverlay.value = answer.value === null || history === null ? null : overlayOf(answer.value, truth.value, history);
  }, [answer.value, history, store.at.value, store.shownFloor.value]);
  useEffect(() => () => {
    lostOverlay.value = null;
  }, []);
  if (history === null) return null;

  const ask = async (body: () => Promise<unknown>) => {
    const turn = ++newest;
    setBusy(true);
    failed.value = null;
    try {
      const asked = await body();
      const found = await postJson<LostAnswer>(address("/api/relocalize", { at: store.at.value }), asked);
      if (turn !== newest) return;
      answer.value = found;
      if (store.shownFloor.value !== null && found.pose !== null) store.floor.value = history.floors.indexOf(found.pose.floor ?? "");
    } catch (error) {
      if (turn !== newest) return;
      answer.value = null;
      failed.value = sentence(error);
    } finally {
      if (turn === newest) setBusy(false);
    }
  };
  const askKeyframe = () => {
    question.value = null;
    return ask(async () => {
      const found = await getJson<QuestionAnswer>(address("/api/question", { keyframe: keyframe.value, known_at: history.knownAt }));
      truth.value = found.truth === null ? null : { x: found.truth[0], y: found.truth[1], yaw: found.truth[2], floor: history.keyframes.floor[found.number] };
      if (before.value) goTo(found.ask_at);
      return found.question;
    });
  };
  const askFile = async (file: File | undefined) => {
    if (file === undefined) return;
    if (file.size > MOST_BYTES) {
      failed.value = `${label(file.name, 60)} has ${file.size.toLocaleString("en")} bytes; a question has at most ${MOST_BYTES.toLocaleString("en")}.`;
      return;
    }
    const text = await file.text();
    question.value = { name: file.name, text };
    truth.value = null;
    let parsed: unknown;
    try {
      parsed = JSON.parse(text);
    } catch (error) {
      answer.value = null;
      failed.value = `${label(file.name, 60)} is not JSON: ${sentence(error)}`;
      return;
    }
    await ask(() => Promise.resolve(parsed));
  };
  const known = findKeyframe(history, keyframe.value) >= 0;
  return (
    <section class="story">
      <form
        onSubmit={(event) => {
          event.preventDefault();
          void askKeyframe();
        }}
      >
        <label for="lost-keyframe">A keyframe whose crops to ask with, as RUN/ID</label>
        <div class="form-row">
          <input id="lost-keyframe" type="text" spellcheck={false} autoComplete="off" value={keyframe.value} onInput={(event) => (keyframe.value = event.currentTarget.value)} />
          <button class="button main" type="submit" disabled={busy || keyframe.value === ""}>
            {busy ? "Asking …" : "Where is it?"}
          </button>
        </div>
        <label class="check">
          <input type="checkbox" checked={before.value} onChange={() => (before.value = !before.value)} />
          ask the map as it was before this run, or before this keyframe
        </label>
        {!known && keyframe.value !== "" && <p class="dim">This map has no such keyframe.</p>}
      </form>
      <label
        class={over ? "drop over" : "drop"}
        onDragOver={(event) => {
          event.preventDefault();
          setOver(true);
        }}
        onDragLeave={() => setOver(false)}
        onDrop={(event) => {
          event.preventDefault();
          setOver(false);
          void askFile(event.dataTransfer?.files[0]);
        }}
      >
        <input type="file" accept=".json,.jsonl,application/json" onChange={({ currentTarget: input }) => void askFile(input.files?.[0]).finally(() => (input.value = ""))} />
        Drop a question here, or choose a file: an envelope, a list of detections, or crops as JSON
        {question.value !== null && <bdi class="dim">{label(question.value.name, 60)}</bdi>}
      </label>
      {failed.value !== null && <p class="error" role="alert">{failed.value}</p>}
      {answer.value !== null && <LikelyPlaces answer={answer.value} />}
    </section>
  );
}

function LikelyPlaces({ answer: found }: { answer: LostAnswer }) {
  const history = store.history.value;
  if (history === null) return null;
  const { pose, places, confidence, unknown } = found;
  return (
    <div class="answer">
      <p class="summary">
        {places.length === 0
          ? "Nothing in the map looks like these crops."
          : unknown
            ? `Unknown: the confidence ${confidence.toFixed(2)} is too low. The likeliest places would be:`
            : `Confidence ${confidence.toFixed(2)}.`}
        {pose !== null && ` Pose (${pose.x.toFixed(2)}, ${pose.y.toFixed(2)}) m${pose.floor === undefined ? "" : ` on floor ${isolated(label(pose.floor))}`}${pose.yaw === null ? "" : `, facing ${Math.round((pose.yaw * 180) / Math.PI)}°`}, spread ${pose.spread_m.toFixed(2)} m.`}
        {truth.value !== null && pose !== null && ` The true pose is ${Math.hypot(truth.value.x - pose.x, truth.value.y - pose.y).toFixed(2)} m away.`}
      </p>
      <ol class="ranked">
        {places.map((place) => (
          <li key={place.place_id}>
            <div class="score">
              {findPlace(history, place.place_id) >= 0 ? <ThingLink thing={{ kind: "place", id: place.place_id }}>{label(place.name ?? place.place_id, 40)}</ThingLink> : <bdi>{label(place.name ?? place.place_id, 40)}</bdi>}
              <meter min={0} max={1} value={Math.min(1, place.score)} aria-label="Score" />
              <span>{place.score.toFixed(3)}</span>
            </div>
            <ul>
              {place.evidence.map((each, index) => (
                <li key={index}>
                  <span class="dim">{each.similarity.toFixed(3)}</span> {label(each.class_name, 24)}
                  {each.object_id !== null && <> → <ThingLink thing={{ kind: "object", id: each.object_id }} /></>} <span class="dim"><bdi>{label(each.det_id, 28)}</bdi></span>
                </li>
              ))}
            </ul>
          </li>
        ))}
      </ol>
      <CommandLine command={found.command} />
    </div>
  );
}

