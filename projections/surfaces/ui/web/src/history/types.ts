/** The history of a map as arrays, sorted by the offset of the event that made each row. */

export interface Keyframes {
  offset: Int32Array;
  run: Int32Array;
  /** Metres; NaN where the keyframe has no pose. */
  x: Float32Array;
  y: Float32Array;
  yaw: Float32Array;
  stamp: Float64Array;
  id: BigInt64Array;
  /** An index of `floors`; -1 for none. */
  floor: Int32Array;
}

export interface ObjectChanges {
  offset: Int32Array;
  object: Int32Array;
  x: Float32Array;
  y: Float32Array;
  xx: Float32Array;
  xy: Float32Array;
  yy: Float32Array;
  count: Int32Array;
  class: Int32Array;
  place: Int32Array;
  missing: Uint8Array;
  /** 0 for an object that was seen once. */
  confirmed: Uint8Array;
}

export interface TimelineEvents {
  offset: Int32Array;
  stamp: Float64Array;
  /** An index of `eventKinds`. */
  kind: Uint8Array;
  ref: Int32Array;
}

export interface History {
  /** The number of events covered. */
  through: number;
  refoldMs: number;
  keyframes: Keyframes;
  placed: { offset: Int32Array; keyframe: Int32Array; place: Int32Array };
  founded: { offset: Int32Array; place: Int32Array; founder: Int32Array };
  merges: {
    offset: Int32Array;
    survivor: Int32Array;
    absorbed: Int32Array;
    keyframe: Int32Array;
  };
  found: { offset: Int32Array; object: Int32Array; class: Int32Array };
  changes: ObjectChanges;
  objectMerges: { offset: Int32Array; survivor: Int32Array; absorbed: Int32Array };
  edges: { offset: Int32Array; pair: Int32Array; count: Int32Array };
  /** The two places of each pair that `edges` names. */
  pairs: { a: Int32Array; b: Int32Array };
  names: { offset: number; place: number; name: string | null }[];
  events: TimelineEvents;
  eventKinds: string[];
  placeIds: string[];
  objectIds: string[];
  classes: string[];
  runIds: string[];
  floors: string[];
  /** Commands, rejected payloads and losses; `events.ref` is an index of them. */
  system: SystemEvent[];
  refusals: { offset: number; a: number; b: number }[];
  /** Equal while the log only grows: another one means that the past is another too. */
  state: string;
  settings: Record<string, unknown>;
  /** The commands recorded before this offset are in force. */
  knownAt: number;
  /** What positions count from, metres. */
  origin: [number, number];
  /** The arrays as they came, to append to. */
  raw: ReadonlyMap<string, Column>;
}

export type Column = BigInt64Array | Float64Array | Float32Array | Int32Array | Uint32Array | Uint8Array;

export interface SystemEvent {
  offset: number;
  kind: string;
  text: string;
  command_id?: string | null;
  what?: string | null;
  count?: number | null;
}
