/** The density of events with its axis, and marks above it. */

import type { History } from "../history/types";
import type { Palette } from "../map/palette";
import type { Mark, Moments, Stamps } from "../model/moments";
import { densityOf, ticks } from "./density";
import { ROWS_HEIGHT, ROW_HEIGHT, drawMark, rowOf } from "./marks";

const SIDE = 28;
const BIN_PIXELS = 4;
const HIT_PIXELS = 7;
const AXIS_HEIGHT = 22;

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
  private first = 0;
  private last = 1;
  private readonly marks = document.createElement("canvas");

  constructor(private readonly root: HTMLElement) {
    this.marks.className = "marks";
    root.append(this.marks);
  }

  /** Draws; afterwards positions can be asked for. */
  show(data: TrackData) {
    const [width, height] = [this.root.clientWidth, this.root.clientHeight];
    if (width < 40 || height < 40) return;
    this.data = data;
    const { history, stamps, byTime } = data;
    this.first = byTime ? stamps.first : 0;
    this.last = byTime ? Math.max(stamps.last, stamps.first + 1) : Math.max(1, history.through);
    const ratio = window.devicePixelRatio || 1;
    this.marks.width = width * ratio;
    this.marks.height = height * ratio;
    const on = this.marks.getContext("2d") as CanvasRenderingContext2D;
    on.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.drawDensity(on, data, width, height - AXIS_HEIGHT);
    this.drawAxis(on, data, width, height - AXIS_HEIGHT);
    this.drawMarks(on, data, height);
  }

  destroy() {
    this.marks.remove();
  }

  /** Where W is, in pixels from the left of the track. */
  xOf(at: number): number {
    if (this.data === null) return 0;
    const { stamps, byTime } = this.data;
    return this.xOfValue(byTime ? stamps.of(at) : at);
  }

  /** W at a position. */
  atOf(x: number): number {
    if (this.data === null) return 0;
    const { stamps, byTime, history } = this.data;
    const value = this.first + ((x - SIDE) / this.width) * (this.last - this.first);
    return byTime ? stamps.at(value) : Math.max(0, Math.min(history.through, Math.round(value)));
  }

  /** The marks under a point above the density. */
  marksAt(x: number, y: number): Mark[] {
    if (this.data === null || y > ROWS_HEIGHT) return [];
    const near = this.data.moments.marks.filter((mark) => {
      const row = 2 + (rowOf(mark.kind) + 0.5) * ROW_HEIGHT;
      return Math.abs(y - row) < ROW_HEIGHT / 2 + 2 && Math.abs(this.xOfMark(mark) - x) < HIT_PIXELS;
    });
    return near.sort((a, b) => Math.abs(this.xOfMark(a) - x) - Math.abs(this.xOfMark(b) - x));
  }

  private get width(): number {
    return Math.max(1, this.root.clientWidth - 2 * SIDE);
  }

  private xOfValue(value: number): number {
    return SIDE + ((value - this.first) / (this.last - this.first)) * this.width;
  }

  private xOfMark(mark: { offset: number; stamp?: number }): number {
    if (this.data?.byTime) return this.xOfValue(mark.stamp ?? this.data.stamps.of(mark.offset + 1));
    return this.xOfValue(mark.offset + 1);
  }

  private drawDensity(on: CanvasRenderingContext2D, data: TrackData, width: number, bottom: number) {
    const bins = Math.max(10, Math.min(data.history.through || 1, Math.floor((width - 2 * SIDE) / BIN_PIXELS)));
    const counts = densityOf(data.history, this.first, this.last, data.byTime, bins);
    const most = Math.max(1, ...counts);
    const bin = this.width / bins;
    on.beginPath();
    on.moveTo(SIDE, bottom);
    counts.forEach((count, number) => {
      const y = bottom - (count / most) * (bottom - ROWS_HEIGHT - 2);
      on.lineTo(SIDE + number * bin, y);
      on.lineTo(SIDE + (number + 1) * bin, y);
    });
    on.lineTo(width - SIDE, bottom);
    on.fillStyle = data.palette.dark ? "#2b3138" : "#e3e6ea";
    on.fill();
    on.strokeStyle = data.palette.faint;
    on.lineWidth = 1;
    on.stroke();
  }

  private drawAxis(on: CanvasRenderingContext2D, { byTime, palette }: TrackData, width: number, bottom: number) {
    on.font = "11px system-ui, sans-serif";
    on.textAlign = "center";
    on.textBaseline = "top";
    on.fillStyle = palette.dim;
    for (const { value, text } of ticks(this.first, this.last, this.width / (byTime ? 76 : 50), byTime)) {
      const x = this.xOfValue(value);
      on.fillText(text, Math.min(x, width - 2 - on.measureText(text).width / 2), bottom + 7);
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
