import { describe, expect, it } from "vitest";
import { decodeHistory } from "../src/history/decode";
import { compareMoments } from "../src/model/compare";
import { differenceOn, floorName, floorOfObject, floorOfPlace, floorsOf, onFloor } from "../src/model/floors";
import { mapAt } from "../src/model/map_at";
import { type Segment, outlinesOf } from "../src/model/walls";
import { encoded, random, randomTables } from "./histories";

describe("floors", () => {
  const tables = randomTables(11, 200);
  const history = decodeHistory(encoded(tables));
  const floorAt = (offset: number) => tables.rows["kf"].find((row) => row.offset === offset)?.floor;
  it("are listed by their names, that without a name last", () => {
    expect(floorsOf(history).map((floor) => floorName(history, floor))).toEqual(["10", "cellar", "without a name"]);
  });
  it("have the keyframes, places, objects and ways that are on them, and no others", () => {
    for (const at of [0, 50, 120, 200]) {
      const map = mapAt(history, at);
      for (const floor of floorsOf(history)) {
        const shown = onFloor({ history, map }, floor);
        tables.rows["kf"].forEach((row, each) => {
          expect(shown.history.keyframes.x[each]).toBe(row.floor === floor ? row.x : Number.NaN);
        });
        expect(shown.map.places).toEqual(map.places.filter((place) => floorAt(tables.rows["pf"][place].offset) === floor));
        expect(shown.map.objects).toEqual(map.objects.filter((object) => floorAt(tables.rows["of"][object].offset) === floor));
        const touches = ({ a, b }: { a: number; b: number }) => [a, b].some((place) => floorOfPlace(history, place) === floor);
        expect(shown.map.edges).toEqual(map.edges.filter(touches));
      }
    }
  });
  it("divide a difference between them", () => {
    const whole = compareMoments(history, mapAt(history, 40), mapAt(history, 200));
    const parts = floorsOf(history).map((floor) => differenceOn(history, whole, floor));
    expect(parts.flatMap(({ places }) => [...places.keys()]).sort()).toEqual([...whole.places.keys()].sort());
    expect(parts.flatMap(({ objects }) => [...objects.keys()]).sort()).toEqual([...whole.objects.keys()].sort());
    parts.forEach(({ shifts }, index) => {
      for (const { object } of shifts) expect(floorOfObject(history, object)).toBe(floorsOf(history)[index]);
    });
  });
});

describe("walls", () => {
  it("are closed outlines that pass over each side of an occupied cell once", () => {
    for (let seed = 1; seed <= 30; seed++) {
      const { sides, segments } = cells(seed);
      const passed: string[] = [];
      for (const outline of outlinesOf(segments)) {
        for (let i = 0; i < outline.length; i += 2) {
          const [x0, y0] = [outline[i], outline[i + 1]];
          const [x1, y1] = [outline[(i + 2) % outline.length], outline[(i + 3) % outline.length]];
          const length = Math.abs(x1 - x0) + Math.abs(y1 - y0);
          expect(x0 === x1 || y0 === y1).toBe(true);
          for (let k = 0; k < length; k++) passed.push(`${x0 + (Math.sign(x1 - x0) * (2 * k + 1)) / 2} ${y0 + (Math.sign(y1 - y0) * (2 * k + 1)) / 2}`);
        }
      }
      expect(passed.sort()).toEqual(sides.sort());
    }
  });
});

/** The middles of the sides between occupied and free cells, and straight runs of them. */
function cells(seed: number): { sides: string[]; segments: Segment[] } {
  const next = random(seed);
  const size = 7;
  const filled = Array.from({ length: size * size }, () => next() < 0.4);
  const at = (x: number, y: number) => x >= 0 && y >= 0 && x < size && y < size && filled[y * size + x];
  const sides: string[] = [];
  const segments: Segment[] = [];
  for (const upright of [false, true]) {
    const cell = (along: number, across: number) => (upright ? at(across, along) : at(along, across));
    for (let across = 0; across <= size; across++) {
      let start = -1;
      for (let along = 0; along <= size; along++) {
        const side = cell(along, across) !== cell(along, across - 1);
        if (side) sides.push(upright ? `${across} ${along + 0.5}` : `${along + 0.5} ${across}`);
        if (side && start < 0) start = along;
        if (!side && start >= 0) {
          segments.push(upright ? [across, start, across, along] : [start, across, along, across]);
          start = -1;
        }
      }
    }
  }
  return { sides, segments };
}
