/** The timeline: drag, play, step, jump. */

import { effect, untracked } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { DARK, LIGHT } from "../map/palette";
import { isSaved } from "../api/saved";
import { goTo, openPanel, select, showEvent, stepBy, togglePlay } from "../state/actions";
import { markTip, pointedAt } from "../state/pointer";
import * as store from "../state/store";
import { Icon, type IconName } from "../ui/icons";
import { MarkLegend } from "../ui/Legend";
import { when } from "../ui/summary";
import { KIND_NAMES, markText } from "./marks";
import { Track } from "./track";

const SPEEDS = [1, 3, 10, 30, 100, 300, 1000];

export function Timeline() {
  return (
    <section class="timeline" aria-label="Timeline">
      <Transport />
      <TrackView />
    </section>
  );
}

function Transport() {
  const history = store.history.value;
  const at = store.at.value;
  const stamps = store.stamps.value;
  const corrected = !isSaved && history?.system.some(({ kind }) => kind === "correction");
  const jump = (kind: "event" | "change" | "merge", direction: 1 | -1, icon: IconName, says: string, key: string) => (
    <button class="icon" type="button" title={`${says} (${key})`} aria-label={says} onClick={() => stepBy(kind, direction)}>
      <Icon name={icon} />
    </button>
  );
  return (
    <div class="transport">
      <div class="group">
        {jump("merge", -1, "merge-back", "Previous merge", "Shift+M")}
        {jump("change", -1, "change-back", "Previous change", "Shift+←")}
        {jump("event", -1, "step-back", "Previous event", "←")}
        <button class="icon play" type="button" aria-pressed={store.playing.value} aria-label={store.playing.value ? "Pause" : "Play"} title={store.playing.value ? "Pause (space)" : "Play (space)"} onClick={togglePlay}>
          <Icon name={store.playing.value ? "pause" : "play"} />
        </button>
        {jump("event", 1, "step", "Next event", "→")}
        {jump("change", 1, "change", "Next change", "Shift+→")}
        {jump("merge", 1, "merge", "Next merge", "M")}
      </div>
      <label class="inline">
        <span class="hidden">Speed of playing</span>
        <select value={String(store.speed.value)} title="Speed of playing" onChange={(event) => (store.speed.value = Number(event.currentTarget.value))}>
          {SPEEDS.map((each) => (
            <option key={each} value={String(each)}>{`×${each}`}</option>
          ))}
        </select>
      </label>
      <div class="moment">
        <label class="inline">
          <span class="hidden">Moment: number of events</span>
          <input class="at" inputMode="numeric" value={String(at)} size={7} title="Number of events that the map covers" onChange={(event) => goTo(Number(event.currentTarget.value.replace(/\D/g, "") || at))} />
        </label>
        <span class="dim of">of {(history?.through ?? 0).toLocaleString("en")} events</span>
        <Clock />
      </div>
      <MarkLegend />
      <span class="space" />
      {corrected && (
        <div class="known">
        <span class="dim">as known</span>
        <fieldset class="segments" aria-busy={store.wantedKnownAt.value !== store.shownKnownAt.value} title="then: under the corrections recorded before this moment; now: under all of them">
          <legend class="hidden">Corrections in force</legend>
          {(["then", "now"] as const).map((each) => (
            <label key={each} class={store.known.value === each ? "on" : ""}>
              <input type="radio" name="known" aria-label={`As known ${each}`} checked={store.known.value === each} onChange={() => (store.known.value = each)} />
              {each}
            </label>
          ))}
        </fieldset>
        </div>
      )}
      <fieldset class="segments">
        <legend class="hidden">Axis of the timeline</legend>
        {[false, true].map((time) => (
          <label key={String(time)} class={store.byTime.value === time ? "on" : ""}>
            <input type="radio" name="axis" checked={store.byTime.value === time} disabled={time && !(stamps?.any ?? false)} onChange={() => (store.byTime.value = time)} />
            {time ? "Time" : "Events"}
          </label>
        ))}
      </fieldset>
    </div>
  );
}

/** The time of the last event before W; of the event under the pointer, with its number, where that is on the track. */
function Clock() {
  const [at, stamps] = [pointedAt.value ?? store.at.value, store.stamps.value];
  const time = stamps === null || at <= 0 ? "" : when(stamps.of(at)).replace(/\.000$/, "");
  return (
    <span class="dim time">
      {pointedAt.value === null ? "" : `event ${(at - 1).toLocaleString("en")}  `}
      {time}
    </span>
  );
}

function TrackView() {
  const root = useRef<HTMLDivElement>(null);
  const head = useRef<HTMLDivElement>(null);
  const other = useRef<HTMLDivElement>(null);
  const pointed = useRef<HTMLDivElement>(null);
  useEffect(() => {
    const host = root.current as HTMLDivElement;
    const track = new Track(host);
    const place = () => {
      const line = head.current as HTMLDivElement;
      line.style.transform = `translateX(${track.xOf(store.at.value)}px)`;
      const lane = track.laneY(store.at.value);
      line.style.setProperty("--lane", lane === null ? "-20px" : `${lane}px`);
      const hair = pointed.current as HTMLDivElement;
      hair.hidden = pointedAt.value === null;
      if (pointedAt.value !== null) hair.style.transform = `translateX(${track.xOf(pointedAt.value)}px)`;
      const mark = other.current as HTMLDivElement;
      const moment = store.panel.value === "compare" && store.compareMode.value === "moments" ? store.compareWith.value : null;
      mark.hidden = moment === null;
      if (moment !== null) mark.style.transform = `translateX(${track.xOf(moment)}px)`;
    };
    const show = () => {
      const [history, moments, stamps] = [store.history.value, store.moments.value, store.stamps.value];
      if (history === null || moments === null || stamps === null) return;
      const palette = store.dark.value ? DARK : LIGHT;
      const byTime = store.byTime.value && stamps.any;
      track.show({ history, moments, stamps, byTime, palette, found: store.foundAt.value });
      untracked(place);
    };
    const stops = [effect(show), effect(place)];
    const observer = new ResizeObserver(show);
    observer.observe(host);
    const stopPointer = followPointer(host, track);
    return () => {
      stops.forEach((stop) => stop());
      observer.disconnect();
      stopPointer();
      track.destroy();
    };
  }, []);
  const history = store.history.value;
  const text = [`${store.at.value} of ${history?.through ?? 0} events`, when(store.stamps.value?.of(store.at.value) ?? Number.NaN).slice(0, 19)].filter(Boolean).join(", ");
  return (
    <div
      class="track"
      ref={root}
      role="slider"
      tabIndex={0}
      aria-label="Moment"
      aria-orientation="horizontal"
      aria-valuemin={0}
      aria-valuemax={history?.through ?? 0}
      aria-valuenow={store.at.value}
      aria-valuetext={text}
    >
      <div class="other-head" ref={other} hidden />
      <div class="pointed" ref={pointed} hidden />
      <div class="head" ref={head} />
    </div>
  );
}

function followPointer(host: HTMLElement, track: Track): () => void {
  let dragging = false;
  const at = (event: PointerEvent) => {
    const box = host.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top] as const;
  };
  const down = (event: PointerEvent) => {
    if (event.button !== 0) return;
    const [x, y] = at(event);
    const mark = track.marksAt(x, y)[0];
    markTip.value = null;
    store.playing.value = false;
    if (mark !== undefined) {
      showEvent(mark.offset);
      const history = store.history.value;
      if (history === null) return;
      if (mark.kind === "place_merged") select({ kind: "merge", id: String(mark.offset) }, true);
      if (mark.kind === "place_founded") select({ kind: "place", id: history.placeIds[mark.ref] }, true);
      if (mark.kind === "object_missing" || mark.kind === "object_moved") select({ kind: "object", id: history.objectIds[mark.ref] }, true);
      if (mark.kind === "correction") openPanel("correct");
      return;
    }
    dragging = true;
    host.setPointerCapture(event.pointerId);
    goTo(track.atOf(x, y));
  };
  const move = (event: PointerEvent) => {
    const [x, y] = at(event);
    if (dragging) {
      pointedAt.value = null;
      goTo(track.atOf(x, y));
      return;
    }
    const marks = track.marksAt(x, y);
    host.classList.toggle("over-mark", marks.length > 0);
    const history = store.history.value;
    pointedAt.value = marks[0] === undefined ? track.atOf(x, y) : marks[0].offset + 1;
    const idle = track.foldAt(x);
    if (marks.length === 0 || history === null) markTip.value = idle === null ? null : { x: event.clientX, y: event.clientY, lines: [`${idle} without an event`] };
    else {
      const lines = marks.slice(0, 5).map((mark) => `${mark.offset}  ${markText(history, mark)}`);
      if (marks.length > 5) lines.push(`and ${marks.length - 5} more`);
      markTip.value = { x: event.clientX, y: event.clientY, lines: [KIND_NAMES[marks[0].kind], ...lines] };
    }
  };
  const up = () => {
    dragging = false;
  };
  const leave = () => {
    markTip.value = pointedAt.value = null;
  };
  host.addEventListener("pointerdown", down);
  host.addEventListener("pointermove", move);
  host.addEventListener("pointerup", up);
  host.addEventListener("pointercancel", up);
  host.addEventListener("pointerleave", leave);
  return () => {
    host.removeEventListener("pointerdown", down);
    host.removeEventListener("pointermove", move);
    host.removeEventListener("pointerup", up);
    host.removeEventListener("pointercancel", up);
    host.removeEventListener("pointerleave", leave);
  };
}
