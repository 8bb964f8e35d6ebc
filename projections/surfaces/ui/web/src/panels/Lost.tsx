/** Where a robot is that sees some things: asked with crops of a keyframe, or with a question in a file. */

import { batch, signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { address, getJson, postJson } from "../api/client";
import type { Crop } from "../api/types";
import { counted, findPlace, isolated, keyframeTitle, label, shortPlace } from "../model/names";
import { goTo } from "../state/actions";
import { useAnswer } from "../state/answers";
import { sentence } from "../state/loading";
import { lostOverlay, lostPoint } from "../state/overlays";
import * as store from "../state/store";
import { type LostAnswer, type Truth, overlayOf } from "./lost_answer";
import { CommandLine, ThingLink } from "./AnswerParts";

/** As the server takes. */
const MOST_BYTES = 1_000_000;

interface AskedCrop {
  det_id: string;
  class: string;
}

interface QuestionAnswer {
  keyframe: string;
  number: number;
  question: { crops: AskedCrop[] };
  truth: [number, number, number] | null;
  ask_at: number;
  whole: boolean;
}

/** What the field says. */
const keyframe = signal("");
/** The keyframe whose crops are asked with. */
const picked = signal<QuestionAnswer | null>(null);
/** Those of its crops that are not asked with. */
const left = signal<ReadonlySet<string>>(new Set());
const fileName = signal<string | null>(null);
const answer = signal<LostAnswer | null>(null);
const truth = signal<Truth | null>(null);
/** Whether to ask the map as it was before it knew the keyframe's run. */
const before = signal(true);
const failed = signal<string | null>(null);
/** Which question is the newest: the answers of others are not shown. */
let newest = 0;

export function Lost() {
  const history = store.history.value;
  const [busy, setBusy] = useState(false);
  const [over, setOver] = useState(false);
  const selected = store.selection.value;

  /** One question after the other; of two only the later one is answered. */
  const turn = async (work: (stale: () => boolean) => Promise<void>) => {
    const mine = ++newest;
    const stale = () => mine !== newest;
    setBusy(true);
    failed.value = null;
    try {
      await work(stale);
    } catch (error) {
      if (stale()) return;
      answer.value = null;
      failed.value = sentence(error);
    } finally {
      if (!stale()) setBusy(false);
    }
  };
  /** Takes the crops of a keyframe: of the one named, near a point, or that the server picks. */
  const take = async (which: Record<string, string | null>, stale: () => boolean) => {
    const found = await getJson<QuestionAnswer>(address("/api/question", { ...which, known_at: history?.knownAt }));
    if (stale() || history === null) return;
    batch(() => {
      picked.value = found;
      keyframe.value = keyframeTitle(found.keyframe);
      fileName.value = answer.value = null;
      left.value = new Set();
      truth.value = found.truth === null ? null : { x: found.truth[0], y: found.truth[1], yaw: found.truth[2], floor: history.keyframes.floor[found.number] };
    });
  };
  const ask = async (body: unknown, at: number, stale: () => boolean) => {
    const found = await postJson<LostAnswer>(address("/api/relocalize", { at }), body);
    if (stale() || history === null) return;
    answer.value = found;
    if (store.shownFloor.value !== null && found.pose !== null) store.floor.value = history.floors.indexOf(found.pose.floor ?? "");
  };
  const askPicked = async (stale: () => boolean) => {
    const found = picked.value;
    if (found === null || stale()) return;
    const crops = found.question.crops.filter(({ det_id }) => !left.value.has(det_id));
    await ask({ ...found.question, crops }, before.value || found.whole ? found.ask_at : store.at.value, stale);
  };
  useEffect(() => {
    if (history === null || history.keyframes.offset.length === 0) return;
    const thing = store.selection.peek();
    if (thing?.kind === "keyframe" && thing.id !== picked.value?.keyframe) void turn((stale) => take({ keyframe: thing.id }, stale));
    else if (picked.value === null && fileName.value === null) void turn((stale) => take({}, stale));
  }, [selected?.id, history === null]);
  const point = lostPoint.value;
  useEffect(() => {
    if (point === null || history === null) return;
    lostPoint.value = null;
    const floor = store.shownFloor.value === null ? null : history.floors[store.shownFloor.value];
    void turn(async (stale) => {
      await take({ near: `${point.x + history.origin[0]},${point.y + history.origin[1]}`, floor }, stale);
      await askPicked(stale);
    });
  }, [point]);
  useEffect(() => {
    lostOverlay.value = answer.value === null || history === null ? null : overlayOf(answer.value, truth.value, history);
  }, [answer.value, history, store.at.value, store.shownFloor.value]);
  useEffect(() => () => {
    lostOverlay.value = null;
  }, []);
  if (history === null) return null;

  const askFile = async (file: File | undefined) => {
    if (file === undefined) return;
    if (file.size > MOST_BYTES) {
      failed.value = `${label(file.name, 60)} has ${file.size.toLocaleString("en")} bytes; a question has at most ${MOST_BYTES.toLocaleString("en")}.`;
      return;
    }
    const text = await file.text();
    batch(() => {
      fileName.value = file.name;
      picked.value = truth.value = null;
    });
    await turn(async (stale) => {
      let parsed: unknown;
      try {
        parsed = JSON.parse(text);
      } catch (error) {
        throw new Error(`${label(file.name, 60)} is not JSON: ${sentence(error)}`);
      }
      await ask(parsed, store.at.value, stale);
    });
  };
  const found = picked.value;
  const chosen = found?.question.crops.filter(({ det_id }) => !left.value.has(det_id)).length ?? 1;
  return (
    <section class="story">
      <form
        onSubmit={(event) => {
          event.preventDefault();
          void turn(async (stale) => {
            if (keyframeTitle(keyframe.value) !== keyframeTitle(picked.value?.keyframe ?? "")) await take({ keyframe: keyframe.value }, stale);
            await askPicked(stale);
          });
        }}
      >
        <p class="dim">Click on the map to ask from there, or name a keyframe.</p>
        <label for="lost-keyframe">A keyframe whose crops to ask with, as RUN:ID</label>
        <div class="form-row">
          <input id="lost-keyframe" type="text" spellcheck={false} autoComplete="off" value={keyframe.value} onInput={(event) => (keyframe.value = event.currentTarget.value)} />
          <button class="button main" type="submit" disabled={busy || keyframe.value === "" || chosen === 0}>
            {busy ? "Asking …" : "Where is it?"}
          </button>
        </div>
        {found !== null && <Crops key={found.keyframe} of={found} />}
        {found !== null && <WhichMap of={found} />}
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
        {fileName.value !== null && <bdi class="dim">{label(fileName.value, 60)}</bdi>}
      </label>
      {failed.value !== null && <p class="error" role="alert">{failed.value}</p>}
      {answer.value !== null && <LikelyPlaces answer={answer.value} />}
    </section>
  );
}

/** The crops of the keyframe, as pictures where the log keeps them: those pressed are asked with. */
function Crops({ of: { keyframe: id, question } }: { of: QuestionAnswer }) {
  const through = store.history.value?.through ?? 0;
  const kept = useAnswer<{ pictures: Crop[] }>(address("/api/pictures", { what: `keyframe:${id}`, at: through })).value?.pictures ?? [];
  const pictures = new Map(kept.map((each) => [each.det_id, each.jpeg]));
  const turn = (id: string) => {
    const next = new Set(left.value);
    if (!next.delete(id)) next.add(id);
    left.value = next;
  };
  return (
    <fieldset class="choose">
      <legend>{counted(question.crops.length - left.value.size, "crop")} of {question.crops.length}: click to leave one out</legend>
      {question.crops.map(({ det_id, class: name }) => (
        <button key={det_id} type="button" aria-pressed={!left.value.has(det_id)} title={label(det_id, 60)} onClick={() => turn(det_id)}>
          {pictures.has(det_id) && <img src={`data:image/jpeg;base64,${pictures.get(det_id)}`} alt="" />}
          <bdi>{label(name, 20)}</bdi>
        </button>
      ))}
    </fieldset>
  );
}

/** Which map is asked, and why; the timeline stays where it is. */
function WhichMap({ of: { keyframe: id, ask_at, whole } }: { of: QuestionAnswer }) {
  const run = <bdi>{label(id.replace(/\/[^/]*$/, ""), 40)}</bdi>;
  if (whole) return <p class="note">No map is older than the run {run}, so the whole map is asked. It has these very crops; a robot that is really lost is harder to find.</p>;
  return (
    <>
      <label class="check">
        <input type="checkbox" checked={before.value} onChange={() => (before.value = !before.value)} />
        ask the map as it was before this run, not the one shown
      </label>
      {before.value && (
        <p class="note">
          The map before {run} began is asked: that of {counted(ask_at, "event")}.{" "}
          {store.at.value !== ask_at && <button type="button" class="link" onClick={() => goTo(ask_at)}>Show it</button>}
        </p>
      )}
    </>
  );
}

function LikelyPlaces({ answer: found }: { answer: LostAnswer }) {
  const history = store.history.value;
  if (history === null) return null;
  const { pose, places, confidence, unknown, spots } = found;
  /** As the map shown calls it, which may know more than the one that was asked. */
  const nameNow = ({ place_id, name }: LostAnswer["places"][number]) => store.map.value?.name[findPlace(history, place_id)] ?? name ?? shortPlace(history, findPlace(history, place_id));
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
      {spots.length > 1 && (
        <p>
          Or it is {spots.slice(1).map(({ x, y, share }) => `at (${x.toFixed(1)}, ${y.toFixed(1)}) m, ${Math.round(100 * share)} %`).join("; ")}.
        </p>
      )}
      <ol class="ranked">
        {places.map((place) => (
          <li key={place.place_id}>
            <div class="score">
              {findPlace(history, place.place_id) >= 0 ? <ThingLink thing={{ kind: "place", id: place.place_id }}>{label(nameNow(place), 40)}</ThingLink> : <bdi>{label(place.name ?? place.place_id, 40)}</bdi>}
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
