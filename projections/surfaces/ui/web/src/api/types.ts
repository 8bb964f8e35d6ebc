/** The answers of the server that the page reads; docs/ui.md has them in full. */

export interface LogInfo {
  name: string;
  path?: string;
  log_id: string;
  events: number;
  through: number;
  state?: string;
  runs: { run_id: string; first_offset: number; keyframes: number }[];
  settings: Record<string, unknown>;
  changed_settings?: Record<string, unknown>;
  fingerprint: string;
  fusion: string;
  places_rule: string;
  places_text: string;
  edits_allowed: boolean;
  token_needed: boolean;
  problems: string[];
  walls?: [number, number, number, number][];
  /** The occupancy maps that events gave; one that names no floor is of the first. */
  maps?: { offset: number; floor: string | null }[];
  loading?: { done: boolean; folded: number; events: number };
}

export interface Ref {
  kind: "place" | "object" | "keyframe" | "merge" | string;
  id: string;
  /** As the text beside it has it, where that is not the id. */
  name?: string;
}

export interface Step {
  offset: number;
  text: string;
  time?: string | null;
  what?: string;
  refs?: Ref[];
}

export interface Answer {
  lines?: string[];
  command?: string;
}

/** An Object that `mapfold find --json` answers with; docs/find.md has all of it. */
export interface FoundObject {
  object_id: string;
  class_name: string;
  place_id: string | null;
  place_name: string | null;
  place_type: string | null;
  obs_count: number;
  last_seen: { iso: string };
  missing_in: string | null;
}

export interface FoundObjects {
  match: string;
  classes: string[];
  count: number;
  unconfirmed: number;
  answers: FoundObject[];
}

/** A thing whose name has a text. `number` is its row, that of the keyframe for a detection. */
export interface NamedThing {
  kind: string;
  id: string;
  number: number;
  text: string;
  offset: number;
  stands: boolean;
}

/** A GeoJSON geometry in metres of the map frame; rings are closed. */
export type Geometry =
  | { type: "Polygon"; coordinates: number[][][] }
  | { type: "MultiPolygon"; coordinates: number[][][][] };

/** A place as `ask` lists it. `type` is null where its probability, that of the first candidate, is below a half; `region` is the free floor where walls are known. */
export interface Room {
  place_id: string;
  name: string | null;
  type: string | null;
  type_probability: number | null;
  candidates: [string, number][];
  floor: string | null;
  area_m2: number | null;
  region: Geometry | null;
  objects: number;
  unconfirmed: number;
  last_visited: { iso: string };
}

/** What the server knows about the map at W: its rooms, and what is odd about it. */
export interface MapFacts {
  at: number;
  known_at: number;
  rooms: Room[];
  odd: { says: string; command: string }[];
  /** Whether the log keeps pictures. */
  crops: boolean;
}

/** What became of an Object between two moments, for sure. */
export interface MapChange {
  kind: "moved" | "missing" | "new" | "back";
  object_id: string;
  class_name: string;
  place_id: string | null;
  place_name: string | null;
  place_type: string | null;
  from: [number, number] | null;
  to: [number, number] | null;
  moved_m: number | null;
  seen: { iso: string; offset: number };
  sentence: string;
}

export interface MapChanges {
  since: number;
  until: number;
  counts: Record<MapChange["kind"], number>;
  unsure: number;
  changes: MapChange[];
  command: string;
}

/** The crop of a detection, a JPEG in base64; `picture` is the size of the whole picture, where that is known. */
export interface Crop {
  det_id: string;
  class_name: string;
  confidence: number;
  bbox: [number, number, number, number];
  picture: [number, number] | null;
  run_id: string;
  keyframe_id: number;
  offset: number;
  jpeg: string;
}
