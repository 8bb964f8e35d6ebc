/** Reads the binary answer of `/api/history`: a JSON header, then arrays aligned to 8 bytes. */

import type { Column, History, SystemEvent } from "./types";

interface Listed {
  name: string;
  dtype: keyof typeof TYPES;
  length: number;
  offset: number;
}

interface Header {
  from: number;
  through: number;
  state: string;
  known_at: number;
  refold_ms?: number;
  arrays: Listed[];
  origin?: [number, number];
  strings: Record<"place_id" | "object_id" | "class" | "run_id" | "floor", string[]>;
  names: { offset: number; place: number; name: string | null }[];
  kinds: string[];
  system?: SystemEvent[];
  refusals?: { offset: number; a: number; b: number }[];
  settings: Record<string, unknown>;
}

const TYPES = {
  i8: BigInt64Array,
  f8: Float64Array,
  f4: Float32Array,
  i4: Int32Array,
  u4: Uint32Array,
  u1: Uint8Array,
} as const;

export class HistoryFormatError extends Error {}

/** A whole history, or with `before` that one and the rows that came since. */
export function decodeHistory(answer: ArrayBuffer, before: History | null = null): History {
  const length = new DataView(answer).getUint32(0, true);
  const text = new TextDecoder().decode(new Uint8Array(answer, 4, length));
  const header = JSON.parse(text) as Header;
  const raw = new Map<string, Column>();
  for (const { name, dtype, length, offset } of header.arrays) {
    const column = new TYPES[dtype](answer, offset, length);
    raw.set(name, before === null ? column : joined(before.raw.get(name), column));
  }
  const { strings } = header;
  return assembled(raw, {
    through: header.through,
    refoldMs: header.refold_ms ?? 0,
    state: header.state,
    knownAt: header.known_at,
    names: [...(before?.names ?? []), ...header.names],
    eventKinds: header.kinds,
    placeIds: [...(before?.placeIds ?? []), ...strings.place_id],
    objectIds: [...(before?.objectIds ?? []), ...strings.object_id],
    classes: strings.class,
    runIds: strings.run_id,
    floors: strings.floor,
    system: [...(before?.system ?? []), ...(header.system ?? [])],
    refusals: [...(before?.refusals ?? []), ...(header.refusals ?? [])],
    settings: header.settings,
    origin: header.origin ?? [0, 0],
  });
}

function joined(first: Column | undefined, second: Column): Column {
  if (first === undefined || first.length === 0) return second;
  const Type = second.constructor as new (length: number) => Float64Array;
  const both = new Type(first.length + second.length);
  both.set(first as Float64Array); // both are of one type, whichever it is
  both.set(second as Float64Array, first.length);
  return both;
}

type Arrays =
  | "keyframes" | "placed" | "founded" | "merges" | "found" | "changes"
  | "objectMerges" | "edges" | "pairs" | "events" | "raw";

function assembled(raw: Map<string, Column>, rest: Omit<History, Arrays>): History {
  function read<T extends Column>(name: string, Type: new (length: number) => T): T {
    const column = raw.get(name);
    if (column instanceof Type) return column;
    throw new HistoryFormatError(
      `the server's history has no array ${name} of type ${Type.name}: page and server are of ` +
        "different versions of mapfold. Restart the server and load the page again",
    );
  }
  const i4 = (name: string) => read(name, Int32Array);
  const f4 = (name: string) => read(name, Float32Array);
  const { pair, pairs } = numberPairs(i4("ad_a"), i4("ad_b"));
  return {
    ...rest,
    raw,
    keyframes: {
      offset: i4("kf_offset"),
      run: i4("kf_run"),
      x: f4("kf_x"),
      y: f4("kf_y"),
      yaw: f4("kf_yaw"),
      stamp: read("kf_stamp", Float64Array),
      id: read("kf_id", BigInt64Array),
      floor: i4("kf_floor"),
    },
    placed: { offset: i4("pl_offset"), keyframe: i4("pl_keyframe"), place: i4("pl_place") },
    founded: { offset: i4("pf_offset"), place: i4("pf_place"), founder: i4("pf_founder") },
    merges: {
      offset: i4("mg_offset"),
      survivor: i4("mg_survivor"),
      absorbed: i4("mg_absorbed"),
      keyframe: i4("mg_keyframe"),
    },
    found: { offset: i4("of_offset"), object: i4("of_object"), class: i4("of_class") },
    changes: {
      offset: i4("oc_offset"),
      object: i4("oc_object"),
      x: f4("oc_x"),
      y: f4("oc_y"),
      xx: f4("oc_xx"),
      xy: f4("oc_xy"),
      yy: f4("oc_yy"),
      count: i4("oc_count"),
      class: i4("oc_class"),
      place: i4("oc_place"),
      missing: read("oc_missing", Uint8Array),
      confirmed: read("oc_confirmed", Uint8Array),
    },
    objectMerges: {
      offset: i4("om_offset"),
      survivor: i4("om_survivor"),
      absorbed: i4("om_absorbed"),
    },
    edges: { offset: i4("ad_offset"), pair, count: i4("ad_count") },
    pairs,
    events: {
      offset: i4("ev_offset"),
      stamp: read("ev_stamp", Float64Array),
      kind: read("ev_kind", Uint8Array),
      ref: i4("ev_ref"),
    },
  };
}

/** Numbers the pairs of places that occur, in the order in which they occur first. */
function numberPairs(a: Int32Array, b: Int32Array) {
  const numbers = new Map<string, number>();
  const pair = new Int32Array(a.length);
  const [first, second]: [number[], number[]] = [[], []];
  for (let row = 0; row < a.length; row++) {
    const key = `${a[row]} ${b[row]}`;
    let number = numbers.get(key);
    if (number === undefined) {
      number = numbers.size;
      numbers.set(key, number);
      first.push(a[row]);
      second.push(b[row]);
    }
    pair[row] = number;
  }
  return { pair, pairs: { a: Int32Array.from(first), b: Int32Array.from(second) } };
}
