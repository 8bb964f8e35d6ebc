import { describe, expect, it } from "vitest";
import { decodeHistory } from "../src/history/decode";
import { mapAt } from "../src/model/map_at";
import { REACH_M, boundsOf, gridOf, regionsOf, ringsOf } from "../src/model/regions";
import { encoded, random, randomTables } from "./histories";

/** Whether a point is inside loops, by the nonzero rule. */
function winding(loops: Float32Array[], x: number, y: number): number {
  let turns = 0;
  for (const loop of loops) {
    for (let i = 0; i < loop.length; i += 2) {
      const [x0, y0] = [loop[i], loop[i + 1]];
      const [x1, y1] = [loop[(i + 2) % loop.length], loop[(i + 3) % loop.length]];
      const side = (x1 - x0) * (y - y0) - (x - x0) * (y1 - y0);
      if (y0 <= y && y1 > y && side > 0) turns++;
      if (y0 > y && y1 <= y && side < 0) turns--;
    }
  }
  return turns;
}

describe("regionsOf", () => {
  it("holds what is nearest to a place's keyframes and within reach, but for the grid's step", () => {
    for (let seed = 1; seed <= 6; seed++) {
      const history = decodeHistory(encoded(randomTables(seed)));
      const map = mapAt(history, history.through);
      const bounds = boundsOf(history);
      if (bounds === null) throw new Error("no poses");
      const grid = gridOf(bounds);
      const { regions, placeAt } = regionsOf(history, map, grid, new Map());
      const next = random(seed + 99);
      let asked = 0;
      for (let point = 0; point < 600; point++) {
        const [x, y] = [bounds.x0 + next() * (bounds.x1 - bounds.x0), bounds.y0 + next() * (bounds.y1 - bounds.y0)];
        const nearest = new Map<number, number>();
        for (let each = 0; each < map.keyframeCount; each++) {
          const place = map.placeOf[each];
          if (place < 0) continue;
          const distance = Math.hypot(history.keyframes.x[each] - x, history.keyframes.y[each] - y);
          nearest.set(place, Math.min(distance, nearest.get(place) ?? Infinity));
        }
        const order = [...nearest].sort((a, b) => a[1] - b[1]);
        const margin = 2.2 * grid.step;
        const clear = order.length < 2 || order[1][1] - order[0][1] > margin;
        if (order.length === 0 || !clear || Math.abs(order[0][1] - REACH_M) < margin) continue;
        asked++;
        const wanted = order[0][1] < REACH_M ? order[0][0] : -1;
        expect(placeAt(x, y)).toBe(wanted);
        for (const { place, loops } of regions) expect(winding(loops, x, y) !== 0).toBe(place === wanted);
      }
      expect(asked).toBeGreaterThan(100);
    }
  });

  it("is the free floor of a place that has one, without its holes, whatever its keyframes are near", () => {
    const history = decodeHistory(encoded(randomTables(3)));
    const map = mapAt(history, history.through);
    const [place, ...others] = map.places;
    const far = [[100, 100], [110, 100], [110, 110], [100, 110], [100, 100]];
    const hole = [[104, 104], [104, 106], [106, 106], [106, 104], [104, 104]];
    const floors = new Map([[place, ringsOf({ type: "Polygon", coordinates: [far, hole] }, history.origin)]]);
    const bounds = boundsOf(history);
    if (bounds === null || others.length === 0) throw new Error("too little");
    const { regions, placeAt } = regionsOf(history, map, gridOf(bounds), floors);
    expect(regions.filter((each) => each.place === place)).toEqual([{ place, loops: floors.get(place) }]);
    expect(new Set(regions.map((each) => each.place)).size).toBeGreaterThan(1);
    expect([placeAt(102, 105), placeAt(105, 105), placeAt(111, 105)]).toEqual([place, -1, -1]);
    const { x, y } = history.keyframes;
    for (let each = 0; each < map.keyframeCount; each++) {
      if (map.placeOf[each] === place) expect(placeAt(x[each], y[each])).not.toBe(place);
    }
  });
});
