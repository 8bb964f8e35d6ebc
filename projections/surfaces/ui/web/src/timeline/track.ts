/** The runs as lanes with the density of events, their axis, and marks above them. */

import type { Palette } from "../map/palette";
import type { History } from "../history/types";
import { label } from "../model/names";
import { type Mark, type Moments, Stamps } from "../model/moments";
import { Axis, busySpans, lengthOf } from "./axis";
import { type Run, densityOf, lanesOf } from "./lanes";
import { ROWS_HEIGHT, ROW_HEIGHT, drawMark, rowOf } from "./marks";

const SIDE = 28;
const BIN_PIXELS = 4;
const HIT_PIXELS = 7;
const AXIS_HEIGHT = 22;
const BETWEEN_LANES = 3;
/** Height of a lane in which the run's name can be read. */
const NAMED_HEIGHT = 12;
const FONT = "system-ui, sans-serif";

export interface TrackData {
  history: History;
  moments: Moments;
  stamps: Stamps;
  byTime: boolean;
  palette: Palette;
  found: readonly { offset: number; becomes: boolean }[];
}

export class Track {
  private data: TrackData | null = null;
  private axis = new Axis([[0, 1]], SIDE, 1);
  private runs: Run[] = [];
  private lanes = 1;
  private readonly ofRun = new Map<number, Stamps>();
  private readonly marks = document.createElement("canvas");

  constructor(private readonly root: HTMLElement) {
    this.marks.className = "marks";
    root.append(this.marks);
  }

  /** Draws; afterwards positions can be asked for. */
  show(data: TrackData) {
    const [width, height] = [this.root.clientWidth, this.root.clientHeight];
    if (width < 40 || height < 40) return;
    const { history, stamps, byTime } = data;
    if (this.data?.history !== history) {
      this.runs = lanesOf(history);
      this.lanes = 1 + Math.max(0, ...this.runs.map(({ lane }) => lane));
      this.ofRun.clear();
    }
    this.data = data;
    this.axis = new Axis(byTime ? busySpans(stamps.sorted) : [[0, Math.max(1, history.through)]], SIDE, width - 2 * SIDE);
    const ratio = window.devicePixelRatio || 1;
    this.marks.width = width * ratio;
    this.marks.height = height * ratio;
    const on = this.marks.getContext("2d") as CanvasRenderingContext2D;
    on.setTransform(ratio, 0, 0, ratio, 0, 0);
    const bottom = height - AXIS_HEIGHT;
    this.drawLanes(on, data, width - 2 * SIDE, bottom);
    this.drawFolds(on, data.palette, bottom);
    this.drawAxis(on, data, width, bottom);
    this.drawMarks(on, data, height);
  }

  destroy() {
    this.marks.remove();
  }

  /** Where W is, in pixels from the left of the track. */
  xOf(at: number): number {
    if (this.data === null) return 0;
    const { stamps, byTime } = this.data;
    return this.axis.xOf(byTime ? stamps.of(at) : at);
  }

  /** The middle of the lane of the run that made the last event before W; null for other events. */
  laneY(at: number): number | null {
    const run = this.data === null || this.lanes < 2 ? undefined : this.runs.find(({ number }) => number === this.data?.stamps.runOf(at));
    if (run === undefined) return null;
    const [top, high] = this.laneAt(run.lane);
    return top + high / 2;
  }

  /** W at a point. By time it is the run of the lane whose event is meant, where it drove then. */
  atOf(x: number, y: number): number {
    if (this.data === null) return 0;
    const { stamps, byTime, history } = this.data;
    const value = this.axis.valueOf(x);
    if (!byTime) return Math.max(0, Math.min(history.through, Math.round(value)));
    const run = this.runs.find((each) => {
      const [top, high] = this.laneAt(each.lane);
      return y >= top && y < top + high + BETWEEN_LANES && value >= each.stamps[0] && value <= each.stamps[1];
    });
    if (run === undefined) return stamps.at(value);
    let own = this.ofRun.get(run.number);
    if (own === undefined) this.ofRun.set(run.number, (own = new Stamps(history, run.number)));
    return own.at(value);
  }

  /** The marks under a point above the lanes. */
  marksAt(x: number, y: number): Mark[] {
    if (this.data === null || y > ROWS_HEIGHT) return [];
    const near = this.data.moments.marks.filter((mark) => {
      const row = 2 + (rowOf(mark.kind) + 0.5) * ROW_HEIGHT;
      return Math.abs(y - row) < ROW_HEIGHT / 2 + 2 && Math.abs(this.xOfMark(mark) - x) < HIT_PIXELS;
    });
    return near.sort((a, b) => Math.abs(this.xOfMark(a) - x) - Math.abs(this.xOfMark(b) - x));
  }

  /** How long nothing happened at a point, in words. */
  foldAt(x: number): string | null {
    const fold = this.data?.byTime ? this.axis.folds.find(({ x0, x1 }) => x > x0 + 1 && x < x1 - 1) : undefined;
    return fold === undefined ? null : lengthOf(fold.seconds);
  }

  private xOfMark(mark: { offset: number; stamp?: number }): number {
    if (this.data?.byTime) return this.axis.xOf(mark.stamp ?? this.data.stamps.of(mark.offset + 1));
    return this.axis.xOf(mark.offset + 1);
  }

  /** Top and height of a lane. */
  private laneAt(lane: number): [number, number] {
    const room = (this.root.clientHeight - AXIS_HEIGHT - ROWS_HEIGHT) / this.lanes;
    return [ROWS_HEIGHT + lane * room, room - (this.lanes > 1 ? BETWEEN_LANES : 0)];
  }

  private drawLanes(on: CanvasRenderingContext2D, { history, stamps, byTime, palette }: TrackData, width: number, bottom: number) {
    const bins = Math.max(10, Math.min(history.through || 1, Math.floor(width / BIN_PIXELS)));
    const bin = width / bins;
    const counts = densityOf(history, this.runs, this.axis, byTime ? stamps : null, SIDE, bin, bins);
    const most = Math.max(1, ...counts.map((lane) => lane.reduce((a, b) => Math.max(a, b), 0)));
    const several = this.lanes > 1;
    const extents = this.runs.flatMap((run) => {
      const [first, last] = byTime ? run.stamps : [run.offsets[0], run.offsets[1] + 1];
      return Number.isFinite(first) && last >= first ? [{ run, x0: this.axis.xOf(first), x1: Math.max(this.axis.xOf(first) + 2, this.axis.xOf(last)) }] : [];
    });
    if (several) {
      on.fillStyle = palette.dark ? "#20252b" : "#f0f2f4";
      for (const { run, x0, x1 } of extents) {
        const [top, high] = this.laneAt(run.lane);
        on.fillRect(x0, top, x1 - x0, high);
      }
    }
    counts.forEach((lane, number) => {
      const [top, high] = several ? this.laneAt(number) : [ROWS_HEIGHT + 2, bottom - ROWS_HEIGHT - 2];
      on.beginPath();
      on.moveTo(SIDE, top + high);
      lane.forEach((count, each) => {
        const y = top + high - (count / most) * high;
        on.lineTo(SIDE + each * bin, y);
        on.lineTo(SIDE + (each + 1) * bin, y);
      });
      on.lineTo(SIDE + width, top + high);
      on.fillStyle = palette.dark ? "#343b44" : "#d5dae0";
      on.fill();
      if (several) return;
      on.strokeStyle = palette.faint;
      on.lineWidth = 1;
      on.stroke();
    });
    if (!several || this.laneAt(0)[1] < NAMED_HEIGHT - 3) return;
    on.font = `10px ${FONT}`;
    on.textAlign = "left";
    on.textBaseline = "middle";
    on.fillStyle = palette.ink;
    for (const { run, x0, x1 } of extents) {
      const [top, high] = this.laneAt(run.lane);
      const name = label(history.runIds[run.number], 40);
      if (on.measureText(name).width + 8 < x1 - x0) on.fillText(name, x0 + 4, top + high / 2 + 0.5);
    }
  }

  /** Where time is folded: two slanted lines. */
  private drawFolds(on: CanvasRenderingContext2D, palette: Palette, bottom: number) {
    on.strokeStyle = palette.dim;
    on.lineWidth = 1;
    for (const { x0, x1 } of this.axis.folds) {
      const x = (x0 + x1) / 2;
      on.beginPath();
      for (const side of x1 - x0 < 8 ? [0] : [-2, 2]) {
        on.moveTo(x + side - 2.5, bottom + 5);
        on.lineTo(x + side + 2.5, bottom - 5);
      }
      on.stroke();
    }
  }

  private drawAxis(on: CanvasRenderingContext2D, { byTime, palette }: TrackData, width: number, bottom: number) {
    on.font = `11px ${FONT}`;
    on.textBaseline = "top";
    on.textAlign = "left";
    on.fillStyle = palette.dim;
    const taken: [number, number][] = [];
    for (const { x, text, begins } of byTime ? this.axis.timeTicks(76) : this.axis.eventTicks(50)) {
      const wide = on.measureText(text).width;
      const from = Math.max(2, Math.min(width - 2 - wide, begins ? x : x - wide / 2));
      if (taken.some(([a, b]) => from < b + 8 && a < from + wide + 8)) continue;
      taken.push([from, from + wide]);
      on.fillText(text, from, bottom + 7);
      on.beginPath();
      on.moveTo(x, bottom);
      on.lineTo(x, bottom + 4);
      on.strokeStyle = palette.faint;
      on.stroke();
    }
  }

  private drawMarks(on: CanvasRenderingContext2D, { moments, palette, found }: TrackData, height: number) {
    const taken = new Set<string>();
    for (const mark of moments.marks) {
      const x = this.xOfMark(mark);
      if (mark.kind === "run_began") {
        on.fillStyle = palette.faint;
        on.fillRect(Math.round(x), 2, 1, height - 24);
        continue;
      }
      const bin = `${mark.kind} ${Math.round(x / 5)}`;
      if (taken.has(bin)) continue;
      taken.add(bin);
      drawMark(on, mark.kind, x, 2 + (rowOf(mark.kind) + 0.5) * ROW_HEIGHT, palette);
    }
    for (const { offset, becomes } of found) {
      const x = Math.round(this.xOfMark({ offset })) + 0.5;
      on.beginPath();
      on.moveTo(x, 2);
      on.lineTo(x, height - 22);
      on.strokeStyle = becomes ? palette.added : palette.removed;
      on.lineWidth = 2;
      on.setLineDash(becomes ? [] : [3, 3]);
      on.stroke();
      on.setLineDash([]);
    }
  }
}
