/** What the page shows, as signals. Panels and the canvas read them; actions.ts changes them. */

import { computed, signal } from "@preact/signals";
import { isSaved, savedMoment } from "../api/saved";
import type { LogInfo, MapFacts, Room } from "../api/types";
import type { History } from "../history/types";
import { type Shown, firstFloor, floorsOf, onFloor } from "../model/floors";
import { findPlace } from "../model/names";
import { type MapState, mapAt } from "../model/map_at";
import { type Moments, Stamps, momentsOf } from "../model/moments";
import { type Bounds, type Grid, type Regions, boundsOf, gridOf, regionsOf, ringsOf } from "../model/regions";
import type { View } from "../map/view";

export type ThingKind = "place" | "object" | "keyframe" | "merge";

/** `id` is that of a place or object, RUN/ID of a keyframe, the offset of a merge. */
export interface Thing {
  kind: ThingKind;
  id: string;
}

export type PanelName = "why" | "compare" | "find" | "lost" | "correct";
/** A saved page has those that need no server. */
export const PANELS: readonly PanelName[] = isSaved ? ["why", "compare"] : ["why", "compare", "find", "lost", "correct"];

export type CompareMode = "moments" | "settings";
export type Theme = "auto" | "light" | "dark";

export const log = signal<LogInfo | null>(null);
export const history = signal<History | null>(null);
/** Why there is no map to show: a sentence. */
export const failure = signal<string | null>(null);
export const serverLost = signal(false);
/** Why the page does not follow the log: a sentence. */
export const refused = signal<string | null>(null);

/** W: the map after the first `at` events. */
export const at = signal(0);
/** Which commands are in force: all of the log's, or those recorded before W. */
export const known = signal<"now" | "then">("now");
/** The commands before this offset are in force in `history`; null for all. */
export const shownKnownAt = signal<number | null>(null);
/** The same of the history that should be shown. */
export const wantedKnownAt = computed<number | null>(() => {
  const commands = (history.value?.system ?? []).filter(({ kind }) => kind === "correction");
  const before = commands.filter(({ offset }) => offset < at.value);
  if (isSaved || known.value === "now" || before.length === commands.length) return null;
  return (before[before.length - 1]?.offset ?? -1) + 1;
});
/** The `known_at` of a question about the map at some W. */
export function knownAt(asked: number): number | null {
  return known.value === "then" && asked === at.value ? null : (history.value?.knownAt ?? null);
}

/** What the server last sent about the map at one W. */
export const mapFacts = signal<MapFacts | null>(null);
/** The same if they belong to the map that is shown, otherwise null. */
export const mapFactsNow = computed(() => {
  const now = known.value === "then" ? at.value : history.value?.knownAt;
  if (isSaved) return mapFacts.value?.at === savedMoment(at.value) ? mapFacts.value : null;
  const fits = mapFacts.value?.at === at.value && mapFacts.value.known_at === now && wantedKnownAt.value === shownKnownAt.value;
  return fits ? mapFacts.value : null;
});
export const rooms = computed<ReadonlyMap<string, Room>>(() => new Map(mapFactsNow.value?.rooms.map((each) => [each.place_id, each])));
/** The command line that gives the map last asked about, and its W. */
export const stateCommand = signal<{ at: number; command: string } | null>(null);
/** W when dragging and playing have rested: what the server is asked about. */
export const restedAt = signal(0);
export const playing = signal(false);
export const speed = signal(10);
export const byTime = signal(false);
/** Whether the page follows the end of the log. */
export const live = signal(false);

export const selection = signal<Thing | null>(null);
export const hovered = signal<Thing | null>(null);
/** What the search found, as long as its list is open. */
export const found = signal<readonly Thing[]>([]);
/** On a phone or tablet the map comes first, and the panel when it is asked for. */
const isNarrow = globalThis.matchMedia?.("(max-width: 900px)").matches ?? false;
export const panel = signal<PanelName | null>(isNarrow ? null : "why");
export const compareMode = signal<CompareMode>("moments");
/** The other moment of a comparison; null until one is chosen. */
export const compareWith = signal<number | null>(null);
/** The other settings of a comparison; null for those of the log. */
export const otherEps = signal<number | null>(null);
export const otherMinSamples = signal<number | null>(null);
export const otherHistory = signal<History | null>(null);
/** Whether the map at the other moment is drawn beside that of this one. */
export const beside = signal(false);
/** What the server sent about the map at the other moment. */
export const otherFacts = signal<MapFacts | null>(null);
export const foundAt = signal<{ offset: number; becomes: boolean }[]>([]);

/** Which objects the table lists, and in which order. */
export const asked = signal({ what: "", room: "", every: false });
export type Column = "class" | "room" | "seen" | "last seen";
export const COLUMNS: readonly Column[] = ["class", "room", "seen", "last seen"];
export const sorted = signal<{ by: Column; down: boolean }>({ by: "seen", down: true });
/** Where the way to what is selected begins: `robot`, an id, or `goal` for no way but the end of one; null for no way. */
export const wayFrom = signal<string | null>(null);
/** The condition of Find. */
export const condition = signal("");

export const theme = signal<Theme>("auto");
export const systemDark = signal(false);
export const dark = computed(() => (theme.value === "auto" ? systemDark.value : theme.value === "dark"));

export const view = signal<View | null>(null);

export const LAYERS = {
  regions: true,
  path: true,
  keyframes: true,
  objects: true,
  once: false,
  ellipses: true,
  edges: true,
  walls: true,
  labels: true,
};
export const layers = signal(LAYERS);
export type LayerName = keyof typeof LAYERS;

export const map = computed<MapState | null>(() =>
  history.value === null ? null : mapAt(history.value, at.value),
);
/** The map when dragging has rested, for what need not follow every move. */
export const restedMap = computed<MapState | null>(() =>
  history.value === null ? null : mapAt(history.value, Math.min(restedAt.value, history.value.through)),
);
/** What the second map shows: this history at the other moment, or that of other settings at this one. */
export const other = computed<{ history: History | null; map: MapState | null }>(() => {
  if (compareMode.value === "moments") return { history: history.value, map: comparedMap.value };
  return { history: otherHistory.value, map: otherHistory.value === null ? null : mapAt(otherHistory.value, at.value) };
});
/** The floor that a person chose; null goes with the robot. */
export const floor = signal<number | null>(null);
/** The floor to show; null where there is only one. */
export const shownFloor = computed<number | null>(() => {
  const [all, now] = [history.value, map.value];
  if (all === null || now === null || floorsOf(all).length < 2) return null;
  if (floor.value !== null && floorsOf(all).includes(floor.value)) return floor.value;
  const { floor: floors, yaw } = all.keyframes;
  let last = now.keyframeCount - 1;
  while (last >= 0 && Number.isNaN(yaw[last])) last--;
  return last < 0 ? firstFloor(all) : floors[last];
});

function seen(from: History | null, state: MapState | null): Shown | null {
  return from === null || state === null ? null : onFloor({ history: from, map: state }, shownFloor.value);
}
/** What the maps show: the part on the floor. */
export const shown = computed(() => seen(history.value, map.value));
export const otherShown = computed(() => seen(other.value.history, other.value.map));

export const moments = computed<Moments | null>(() => (history.value === null ? null : momentsOf(history.value)));
export const stamps = computed<Stamps | null>(() => (history.value === null ? null : new Stamps(history.value)));
export const bounds = computed<Bounds | null>(() => {
  const found = history.value === null ? null : boundsOf(history.value);
  if (found === null) return null;
  for (const [x0, y0, x1, y1] of log.value?.walls ?? []) {
    found.x0 = Math.min(found.x0, x0, x1);
    found.x1 = Math.max(found.x1, x0, x1);
    found.y0 = Math.min(found.y0, y0, y1);
    found.y1 = Math.max(found.y1, y0, y1);
  }
  return found;
});
/** How far beyond drives and walls objects are shown at first, metres: farther ones are errors. */
const BESIDE_M = 3;
/** Those of all that the map shows at its end, also objects. */
export const drawnBounds = computed<Bounds | null>(() => {
  const [all, of] = [bounds.value, history.value];
  if (all === null || of === null) return null;
  const found = { ...all };
  const { object, confirmed, x, y } = of.changes;
  const seen = new Uint8Array(of.objectIds.length);
  for (let row = object.length - 1; row >= 0; row--) {
    if (seen[object[row]] === 1) continue;
    seen[object[row]] = 1;
    if (confirmed[row] === 0) continue;
    found.x0 = Math.min(found.x0, Math.max(x[row], all.x0 - BESIDE_M));
    found.x1 = Math.max(found.x1, Math.min(x[row], all.x1 + BESIDE_M));
    found.y0 = Math.min(found.y0, Math.max(y[row], all.y0 - BESIDE_M));
    found.y1 = Math.max(found.y1, Math.min(y[row], all.y1 + BESIDE_M));
  }
  return found;
});
const grid = computed<Grid | null>(() => (bounds.value === null ? null : gridOf(bounds.value)));

const NO_FLOORS: ReadonlyMap<number, Float32Array[]> = new Map();
/** The free floor of places as the server sent it, and the places that stood then. */
const sentFloors = (sent: typeof mapFacts) => computed(() => {
  const [facts, of] = [sent.value, history.value];
  if (facts === null || of === null) return null;
  const floors = new Map(facts.rooms.flatMap(({ place_id, region }) => (region === null ? [] : [[findPlace(of, place_id), ringsOf(region, of.origin)]])));
  if (floors.size === 0) return null;
  return { floors, places: mapAt(of, Math.min(facts.at, of.through)).places.join() };
});
const [floorsHere, floorsThere] = [sentFloors(mapFacts), sentFloors(otherFacts)];
/** While W moves, the last ones stay as long as the same places stand. */
const floorsIn = (sent: typeof floorsHere.value, now: MapState | null) => (sent !== null && sent.places === now?.places.join() ? sent.floors : NO_FLOORS);
const floorsNow = computed(() => floorsIn(floorsHere.value, map.value));

function regionsIn(part: Shown | null, floors: typeof NO_FLOORS): Regions | null {
  return part === null || grid.value === null ? null : regionsOf(part.history, part.map, grid.value, floors);
}
export const regions = computed(() => regionsIn(shown.value, floorsNow.value));
/** Of a map under other settings the rule of places knows no walls. */
export const otherRegions = computed(() => regionsIn(otherShown.value, compareMode.value === "moments" ? floorsIn(floorsThere.value, comparedMap.value) : NO_FLOORS));

/** The map at the other moment of a comparison, while its panel is open and that moment is not later. */
export const comparedMap = computed<MapState | null>(() =>
  panel.value === "compare" && compareMode.value === "moments" && compareWith.value !== null && compareWith.value <= at.value && history.value !== null
    ? mapAt(history.value, compareWith.value)
    : null,
);
/** Whether two maps are shown side by side. */
export const twoMaps = computed(
  () => panel.value === "compare" && (compareMode.value === "settings" ? otherHistory.value !== null : beside.value && comparedMap.value !== null),
);
