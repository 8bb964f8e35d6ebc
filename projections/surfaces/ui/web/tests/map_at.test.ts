import { describe, expect, it } from "vitest";
import { decodeHistory } from "../src/history/decode";
import { mapAt, rowsBefore } from "../src/model/map_at";
import { type Tables, encoded, randomTables, replay } from "./histories";

function checkAt(tables: Tables, at: number, history = decodeHistory(encoded(tables))) {
  const map = mapAt(history, at);
  const naive = replay(tables, at);
  expect(map.keyframeCount).toBe(naive.placeOf.length);
  expect(Array.from(map.placeOf, (place) => (place < 0 ? null : place))).toEqual(naive.placeOf);
  expect(map.places).toEqual([...naive.members.keys()].sort((a, b) => a - b));
  const { x, y } = history.keyframes;
  for (const [place, members] of naive.members) {
    expect(map.size[place]).toBe(members.length);
    if (members.length === 0) continue;
    const mean = (values: Float32Array) => members.reduce((sum, each) => sum + values[each], 0) / members.length;
    expect(map.x[place]).toBeCloseTo(mean(x), 9);
    expect(map.y[place]).toBeCloseTo(mean(y), 9);
  }
  for (const [place, name] of naive.names) expect(map.name[place]).toBe(name);
  expect(map.objects).toEqual([...naive.objects.keys()].sort((a, b) => a - b));
  for (const object of map.objects) {
    const row = map.objectRow[object];
    const wanted = naive.objects.get(object);
    expect([history.changes.x[row], history.changes.count[row], history.changes.missing[row]]).toEqual([wanted?.x, wanted?.count, wanted?.missing]);
  }
  expect(new Map(map.edges.map(({ a, b, count }) => [`${a} ${b}`, count]))).toEqual(naive.edges);
  const noise = naive.placeOf.filter((place, each) => place === null && !Number.isNaN(x[each])).length;
  expect(map.noise).toBe(noise);
}

describe("mapAt", () => {
  it("is the slow replay of the rows, at every W of random histories", () => {
    for (let seed = 1; seed <= 25; seed++) {
      const tables = randomTables(seed);
      const history = decodeHistory(encoded(tables));
      for (let at = 0; at <= tables.through; at += 7) checkAt(tables, at, history);
      checkAt(tables, tables.through, history);
    }
  });

  it("is empty before the first event, and for an empty log", () => {
    const tables = randomTables(3, 0);
    checkAt(tables, 0);
    expect(mapAt(decodeHistory(encoded(tables)), 0).places).toEqual([]);
  });
});

describe("decodeHistory", () => {
  it("appends what came since: the same history as loaded at once", () => {
    for (let seed = 30; seed < 40; seed++) {
      const tables = randomTables(seed);
      let history = decodeHistory(encoded(tables, 0, 40));
      history = decodeHistory(encoded(tables, 40, 41), history);
      history = decodeHistory(encoded(tables, 41, 120), history);
      const whole = decodeHistory(encoded(tables));
      expect(history.placeIds).toEqual(whole.placeIds);
      expect(history.objectIds).toEqual(whole.objectIds);
      for (const [name, column] of whole.raw) expect(history.raw.get(name), name).toEqual(column);
      for (const at of [0, 39, 40, 41, 80, 120]) checkAt(tables, at, history);
    }
  });

  it("says which array is missing", () => {
    const answer = encoded(randomTables(1));
    const text = new TextDecoder("latin1").decode(answer).replace("kf_yaw", "kf_gap");
    const bytes = Uint8Array.from(text, (char) => char.charCodeAt(0));
    bytes.set(new Uint8Array(answer).subarray(4 + new DataView(answer).getUint32(0, true)), 4 + new DataView(answer).getUint32(0, true));
    new DataView(bytes.buffer).setUint32(0, new DataView(answer).getUint32(0, true), true);
    expect(() => decodeHistory(bytes.buffer)).toThrow(/kf_yaw/);
  });
});

describe("rowsBefore", () => {
  it("counts the values below", () => {
    const values = [0, 0, 2, 5, 5, 9];
    for (let end = -1; end < 11; end++) expect(rowsBefore(values, end)).toBe(values.filter((each) => each < end).length);
  });
});
