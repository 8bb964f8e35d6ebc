/** The walls in force at W on the floor shown. Those of the only map of a log come with the page;
 * of several each is asked for when it is in force first. */

import { computed, effect, signal } from "@preact/signals";
import { address, getJson } from "../api/client";
import { firstFloor } from "../model/floors";
import type { Segment } from "../model/walls";
import * as store from "./store";

const NONE: readonly Segment[] = [];
const asked = signal<ReadonlyMap<number, readonly Segment[]>>(new Map());

/** The number of the map in force; -1 for none. */
const number = computed(() => {
  const [maps, history] = [store.log.value?.maps ?? [], store.history.value];
  if (history === null) return -1;
  const first = firstFloor(history);
  const floor = store.shownFloor.value ?? first;
  const last = (name: string | null) => maps.findLastIndex((each) => each.offset < store.at.value && each.floor === name);
  const named = last(history.floors[floor] ?? null);
  return named < 0 && floor === first ? last(null) : named;
});

export const walls = computed<readonly Segment[]>(() => {
  const log = store.log.value;
  if (number.value < 0) return NONE;
  return (log?.maps?.length === 1 ? log.walls : asked.value.get(number.value)) ?? NONE;
});

export function keepWalls() {
  effect(() => {
    const wanted = number.value;
    if (wanted < 0 || store.log.value?.maps?.length === 1 || asked.value.has(wanted)) return;
    getJson<{ walls: Segment[] }>(address("/api/walls", { number: wanted })).then(
      (answer) => (asked.value = new Map(asked.value).set(wanted, answer.walls)),
      () => {}, // the banner reports a lost server
    );
  });
}
