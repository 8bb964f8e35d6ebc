/** The density of events with its axis (uPlot), marks above it, and the line at W. */

import uPlot from "uplot";
import type { History } from "../history/types";
import type { Palette } from "../map/palette";
import type { Mark, Moments, Stamps } from "../model/moments";
import { when } from "../ui/summary";
import { densityOf } from "./density";
import { ROWS_HEIGHT, ROW_HEIGHT, drawMark, rowOf } from "./marks";

const SIDE = 28;
const BIN_PIXELS = 4;
const HIT_PIXELS = 7;

export interface TrackData {
  history: History;
  moments: Moments;
  stamps: Stamps;
  byTime: boolean;
  palette: Palette;
  found: readonly { offset: number; becomes: boolean }[];
}

/** Times of ticks in UTC, with the day where they span several. */
function timeTexts(stamps: number[]): string[] {
  const days = (stamps[stamps.length - 1] ?? 0) - (stamps[0] ?? 0) > 86_400;
  return stamps.map((stamp) => when(stamp).slice(days ? 5 : 11, days ? 16 : 19));
}

export class Track {
  private plot: uPlot | null = null;
  private data: TrackData | null = null;
  private readonly host = document.createElement("div");
  private readonly marks = document.createElement("canvas");

  constructor(private readonly root: HTMLElement) {
    this.marks.className = "marks";
    root.append(this.host, this.marks);
  }

  /** Draws; `ready` is called when positions can be asked for. */
  show(data: TrackData, ready: () => void) {
    const [width, height] = [this.root.clientWidth, this.root.clientHeight];
    if (width < 40 || height < 40) return;
    this.data = data;
    this.plot?.destroy();
    const { history, stamps, byTime, palette } = data;
    const bins = Math.max(10, Math.min(history.through || 1, Math.floor((width - 2 * SIDE) / BIN_PIXELS)));
    const density = densityOf(history, stamps, byTime, bins);
    const range: [number, number] = byTime ? [stamps.first, stamps.last] : [0, Math.max(1, history.through)];
    this.plot = new uPlot(
      {
        width,
        height,
        padding: [ROWS_HEIGHT + 2, SIDE, 0, SIDE],
        cursor: { show: false },
        hooks: {
          ready: [
            (plot) => {
              if (plot !== this.plot) return;
              this.drawMarks();
              ready();
            },
          ],
        },
        legend: { show: false },
        scales: { x: { time: byTime, range }, y: { range: (_, __, most) => [0, Math.max(1, most)] } },
        axes: [
          {
            size: 22,
            gap: 3,
            font: "11px system-ui, sans-serif",
            stroke: palette.dim,
            grid: { show: false },
            ...(byTime ? { space: 76, values: (_: uPlot, at: number[]) => timeTexts(at) } : { values: (_: uPlot, at: number[]) => at.map((each) => (each % 1 === 0 ? each.toLocaleString("en") : "")) }),
            ticks: { stroke: palette.faint, size: 4, width: 1 },
          },
          { show: false },
        ],
        series: [
          {},
          {
            stroke: palette.faint,
            fill: palette.dark ? "#2b3138" : "#e3e6ea",
            width: 1,
            points: { show: false },
            paths: uPlot.paths.stepped?.({ align: 1 }),
          },
        ],
      },
      [density.x, density.count],
      this.host,
    );
  }

  destroy() {
    this.plot?.destroy();
    this.host.remove();
    this.marks.remove();
  }

  /** Where W is, in pixels from the left of the track. */
  xOf(at: number): number {
    if (this.plot === null || this.data === null) return 0;
    const { stamps, byTime } = this.data;
    return this.xOfValue(byTime ? stamps.of(at) : at);
  }

  /** W at a position. */
  atOf(x: number): number {
    if (this.plot === null || this.data === null) return 0;
    const { stamps, byTime, history } = this.data;
    const value = this.plot.posToVal(x - SIDE, "x");
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

  private xOfValue(value: number): number {
    return SIDE + (this.plot?.valToPos(value, "x") ?? 0);
  }

  private xOfMark(mark: { offset: number; stamp?: number }): number {
    if (this.data?.byTime) return this.xOfValue(mark.stamp ?? this.data.stamps.of(mark.offset + 1));
    return this.xOfValue(mark.offset + 1);
  }

  private drawMarks() {
    if (this.data === null) return;
    const { moments, palette, found } = this.data;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [this.root.clientWidth, this.root.clientHeight];
    this.marks.width = width * ratio;
    this.marks.height = height * ratio;
    const on = this.marks.getContext("2d") as CanvasRenderingContext2D;
    on.setTransform(ratio, 0, 0, ratio, 0, 0);
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
