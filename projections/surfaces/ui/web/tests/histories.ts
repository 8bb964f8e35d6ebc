/** Random histories in the server's binary form, and a slow, obvious replay of their rows. */

export type Row = Record<string, number>;

export interface Tables {
  through: number;
  rows: Record<string, Row[]>;
  placeIds: string[];
  objectIds: string[];
  names: { offset: number; place: number; name: string | null }[];
}

export function random(seed: number): () => number {
  let state = seed * 2654435761 + 1;
  return () => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return state / 2 ** 32;
  };
}

/** A robot that founds, joins and merges places and objects at random. */
export function randomTables(seed: number, events = 120): Tables {
  const next = random(seed);
  const below = (count: number) => Math.floor(next() * count);
  const rows: Record<string, Row[]> = { kf: [], pl: [], pf: [], mg: [], of: [], oc: [], om: [], ad: [], ev: [] };
  const names: Tables["names"] = [];
  const placeIds: string[] = [];
  const objectIds: string[] = [];
  const standing: number[] = [];
  const objects: number[] = [];
  const noise: number[] = [];
  for (let offset = 0; offset < events; offset++) {
    if (next() < 0.1) continue; // an event that changes nothing
    const keyframe = rows.kf.length;
    const posed = next() > 0.1;
    const place = Number.NaN;
    rows.kf.push({ offset, run: below(2), x: posed ? Math.fround(next() * 20) : place, y: posed ? Math.fround(next() * 10) : place, yaw: next(), stamp: 1000 + offset / 2, number: keyframe + 1, id: keyframe + 1, floor: below(3) - 1 });
    rows.ev.push({ offset, stamp: 1000 + offset / 2, kind: 0, ref: keyframe });
    if (posed) noise.push(keyframe);
    if (posed && (standing.length === 0 || next() < 0.1)) {
      rows.pf.push({ offset, place: placeIds.length, founder: keyframe });
      rows.ev.push({ offset, stamp: 1000 + offset / 2, kind: 1, ref: placeIds.length });
      standing.push(placeIds.length);
      placeIds.push(`r_p${placeIds.length}`);
    }
    while (noise.length > 0 && standing.length > 0 && next() < 0.6) {
      const [chosen] = noise.splice(below(noise.length), 1);
      rows.pl.push({ offset, keyframe: chosen, place: standing[below(standing.length)] });
    }
    while (standing.length > 1 && next() < 0.08) {
      const [absorbed] = standing.splice(below(standing.length), 1);
      rows.mg.push({ offset, survivor: standing[below(standing.length)], absorbed, keyframe });
      rows.ev.push({ offset, stamp: 1000 + offset / 2, kind: 2, ref: absorbed });
    }
    if (standing.length > 0 && next() < 0.05) names.push({ offset, place: standing[below(standing.length)], name: next() < 0.3 ? null : `name ${offset}` });
    if (next() < 0.3) {
      rows.of.push({ offset, object: objectIds.length, class: below(3) });
      objects.push(objectIds.length);
      objectIds.push(`obj-${objectIds.length}`);
      rows.oc.push(change(offset, objectIds.length - 1));
    }
    if (objects.length > 0 && next() < 0.5) rows.oc.push(change(offset, objects[below(objects.length)]));
    if (objects.length > 1 && next() < 0.05) {
      const [absorbed] = objects.splice(below(objects.length), 1);
      rows.om.push({ offset, survivor: objects[below(objects.length)], absorbed });
    }
    if (standing.length > 1 && next() < 0.3) rows.ad.push({ offset, a: standing[0], b: standing[1 + below(standing.length - 1)], count: below(4) });
  }
  function change(offset: number, object: number): Row {
    const place = standing.length === 0 || next() < 0.2 ? -1 : standing[below(standing.length)];
    return { offset, object, x: Math.fround(next() * 20), y: Math.fround(next() * 10), xx: 1, xy: 0, yy: 1, count: 1 + below(9), class: below(3), place, missing: below(2), confirmed: below(2) };
  }
  return { through: events, rows, placeIds, objectIds, names };
}

const TYPES: Record<string, string> = {
  kf_id: "i8", kf_x: "f4", kf_y: "f4", kf_yaw: "f4", kf_stamp: "f8",
  oc_x: "f4", oc_y: "f4", oc_xx: "f4", oc_xy: "f4", oc_yy: "f4", oc_missing: "u1", oc_confirmed: "u1",
  ev_stamp: "f8", ev_kind: "u1",
};
const FIELDS: Record<string, string[]> = {
  kf: ["offset", "run", "x", "y", "yaw", "stamp", "number", "id", "floor"],
  pl: ["offset", "keyframe", "place"],
  pf: ["offset", "place", "founder"],
  mg: ["offset", "survivor", "absorbed", "keyframe"],
  of: ["offset", "object", "class"],
  oc: ["offset", "object", "x", "y", "xx", "xy", "yy", "count", "class", "place", "missing", "confirmed"],
  om: ["offset", "survivor", "absorbed"],
  ad: ["offset", "a", "b", "count"],
  ev: ["offset", "stamp", "kind", "ref"],
};
const ARRAYS = { i8: BigInt64Array, f8: Float64Array, f4: Float32Array, i4: Int32Array, u1: Uint8Array };

/** As the server sends the rows of the events from `from` to before `to`. */
export function encoded(tables: Tables, from = 0, to = tables.through): ArrayBuffer {
  const arrays: { name: string; dtype: keyof typeof ARRAYS; values: number[] }[] = [];
  const inside = (row: { offset: number }) => row.offset >= from && row.offset < to;
  for (const [prefix, fields] of Object.entries(FIELDS)) {
    const rows = tables.rows[prefix].filter((row) => inside(row as { offset: number } & Row));
    for (const field of fields) {
      const name = `${prefix}_${field}`;
      arrays.push({ name, dtype: (TYPES[name] ?? "i4") as keyof typeof ARRAYS, values: rows.map((row) => row[field]) });
    }
  }
  const founded = tables.rows.pf.filter((row) => inside(row as { offset: number } & Row)).map((row) => tables.placeIds[row.place]);
  const found = tables.rows.of.filter((row) => inside(row as { offset: number } & Row)).map((row) => tables.objectIds[row.object]);
  const header = (offsets: number[]) =>
    new TextEncoder().encode(
      JSON.stringify({
        from,
        through: to,
        state: "s",
        known_at: to,
        kinds: ["keyframe", "place_founded", "place_merged"],
        settings: {},
        names: tables.names.filter(inside),
        strings: { place_id: founded, object_id: found, class: ["cup", "<b>", "☕"], run_id: ["a", "b"], floor: ["cellar", "10"] },
        arrays: arrays.map(({ name, dtype, values }, index) => ({ name, dtype, length: values.length, offset: String(offsets[index] ?? 0).padStart(9, "0") })).map((each) => ({ ...each, offset: Number(each.offset) })),
      }),
    );
  const aligned = (bytes: number) => Math.ceil(bytes / 8) * 8;
  let start = aligned(4 + header(arrays.map(() => 999_999_999)).length);
  const offsets = arrays.map(({ dtype, values }) => {
    const at = start;
    start = aligned(start + values.length * ARRAYS[dtype].BYTES_PER_ELEMENT);
    return at;
  });
  const answer = new ArrayBuffer(start);
  const head = header(offsets);
  new DataView(answer).setUint32(0, head.length, true);
  new Uint8Array(answer).set(head, 4);
  arrays.forEach(({ dtype, values }, index) => {
    if (dtype === "i8") new BigInt64Array(answer, offsets[index], values.length).set(values.map(BigInt));
    else new ARRAYS[dtype](answer, offsets[index], values.length).set(values);
  });
  return answer;
}

export interface NaiveMap {
  placeOf: (number | null)[];
  members: Map<number, number[]>;
  names: Map<number, string | null>;
  objects: Map<number, Row>;
  edges: Map<string, number>;
}

/** Every row below W applied in turn; a merge moves every member. */
export function replay({ rows, names }: Tables, at: number): NaiveMap {
  const before = (name: string) => rows[name].filter((row) => row.offset < at);
  const placeOf: (number | null)[] = before("kf").map(() => null);
  const members = new Map<number, number[]>();
  const objects = new Map<number, Row>();
  const edges = new Map<string, number>();
  const into = new Map<number, number>();
  const events = ["pf", "pl", "mg", "oc", "om", "ad"].flatMap((name, order) => before(name).map((row) => ({ name, order, row })));
  events.sort((a, b) => a.row.offset - b.row.offset || a.order - b.order);
  for (const { name, row } of events) {
    if (name === "pf") members.set(row.place, []);
    if (name === "pl") {
      let place = row.place;
      while (into.has(place)) place = into.get(place) as number;
      placeOf[row.keyframe] = place;
      members.get(place)?.push(row.keyframe);
    }
    if (name === "mg") {
      let survivor = row.survivor;
      while (into.has(survivor)) survivor = into.get(survivor) as number;
      for (const keyframe of members.get(row.absorbed) ?? []) {
        placeOf[keyframe] = survivor;
        members.get(survivor)?.push(keyframe);
      }
      members.delete(row.absorbed);
      into.set(row.absorbed, survivor);
    }
    if (name === "oc") objects.set(row.object, row);
    if (name === "om") objects.delete(row.absorbed);
    if (name === "ad") {
      const key = `${row.a} ${row.b}`;
      if (row.count > 0) edges.set(key, row.count);
      else edges.delete(key);
    }
  }
  const called = new Map<number, string | null>();
  for (const { offset, place, name } of names) if (offset < at) called.set(place, name);
  return { placeOf, members, names: called, objects, edges };
}
