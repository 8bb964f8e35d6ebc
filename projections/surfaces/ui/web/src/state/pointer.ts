/** What the pointer has opened: the tooltip of the thing under it, the context menu. */

import { signal } from "@preact/signals";
import type { Side } from "../map/current_scene";
import type { Thing } from "./store";

export interface Tip {
  x: number;
  y: number;
  side: Side;
  thing: Thing;
  number: number;
}

export const tip = signal<Tip | null>(null);
export const markTip = signal<{ x: number; y: number; lines: string[] } | null>(null);
/** W under the pointer on the timeline. */
export const pointedAt = signal<number | null>(null);
export const menu = signal<{ x: number; y: number; thing: Thing | null } | null>(null);
/** A line about what just happened, such as "Copied the link."; gone after a while. */
export const notice = signal<string | null>(null);

let timer = 0;
export function showNotice(text: string) {
  notice.value = text;
  clearTimeout(timer);
  timer = window.setTimeout(() => {
    notice.value = null;
  }, 3500);
}
