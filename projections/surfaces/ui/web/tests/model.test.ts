import { describe, expect, it } from "vitest";
import { escaped } from "../src/map/surface";
import { decodeHistory } from "../src/history/decode";
import { placeColours } from "../src/model/colours";
import { compareMoments } from "../src/model/compare";
import { mapAt, shownObjects } from "../src/model/map_at";
import { Stamps, momentsOf, neighbour, playedTo } from "../src/model/moments";
import { findKeyframe, keyframeId, label, shortPlace } from "../src/model/names";
import { foundHit, searchLocally } from "../src/model/search";
import { completions, quoted } from "../src/panels/completion";
import { Axis, busySpans, lengthOf } from "../src/timeline/axis";
import { lanesOf } from "../src/timeline/lanes";
import { objectsText } from "../src/ui/summary";
import { encoded, randomTables } from "./histories";

const history = decodeHistory(encoded(randomTables(5)));

describe("moments", () => {
  const moments = momentsOf(history);
  it("steps to the next and the previous change, each once, and no further", () => {
    const changes = [...moments.changes];
    expect(changes).toEqual([...new Set(changes)].sort((a, b) => a - b));
    for (let at = 0; at <= history.through; at++) {
      expect(neighbour(moments.changes, at, 1)).toBe(changes.find((each) => each > at) ?? null);
      expect(neighbour(moments.changes, at, -1)).toBe(changes.filter((each) => each < at).at(-1) ?? null);
    }
  });
  it("plays on without stepping back, to the end", () => {
    let [at, seconds] = [0, 0];
    while (at < history.through && seconds < 1000) {
      const next = playedTo(history, moments, 0, (seconds += 0.7));
      expect(next).toBeGreaterThanOrEqual(at);
      at = next;
    }
    expect(at).toBe(history.through);
  });
  it("takes a time as all events up to the last one stamped then or earlier", () => {
    const stamps = new Stamps(history);
    const { offset, stamp } = history.events;
    for (let time = stamps.first - 1; time <= stamps.last + 1; time += 0.25) {
      const last = Math.max(-1, ...Array.from(offset).filter((_, row) => stamp[row] <= time));
      expect(stamps.at(time)).toBe(time >= stamps.last ? history.through : last + 1);
    }
  });
});

describe("the axis of time", () => {
  const [march, november] = [1_774_357_200, 1_795_000_000];
  const stamps = Array.from({ length: 600 }, (_, each) => march + each);
  const spans = busySpans([...stamps, november]);
  it("folds what was idle, and leaves a pause that is short beside the rest", () => {
    expect(spans).toEqual([[march, march + 599], [november, november]]);
    expect(busySpans(stamps.filter((each) => each < march + 200 || each > march + 250))).toHaveLength(1);
    expect(busySpans([])).toEqual([]);
  });
  it("is the same both ways, and keeps order", () => {
    const axis = new Axis(spans, 10, 1000);
    for (const each of [...stamps, november]) expect(axis.valueOf(axis.xOf(each))).toBeCloseTo(each, 3);
    expect(axis.xOf(march + 599) - axis.xOf(march)).toBeGreaterThan(900);
    expect([axis.xOf(0), axis.xOf(2 * november)]).toEqual([10, 1010]);
    expect(axis.folds.map(({ seconds }) => lengthOf(seconds))).toEqual(["8 months"]);
    for (const { x } of axis.timeTicks(76)) expect(x).toBeGreaterThanOrEqual(10);
  });
});

describe("lanes", () => {
  it("are of one run each while there are few, and then of runs that are not at the same time", () => {
    const run = Int32Array.from({ length: 80 }, (_, each) => each >> 1);
    const keyframes = { ...history.keyframes, run, offset: Int32Array.from(run.keys()), stamp: Float64Array.from(run, (each, row) => 100 * each + 50 * (row % 2)) };
    const lanes = (runs: number) => lanesOf({ ...history, keyframes, runIds: Array.from({ length: runs }, String) }).map(({ lane }) => lane);
    expect(lanes(40).every((lane) => lane === 0)).toBe(true);
    const few = { ...keyframes, run: run.slice(0, 8), offset: keyframes.offset.slice(0, 8) };
    expect(lanesOf({ ...history, keyframes: few, runIds: ["a", "b", "c", "d"] }).map(({ lane }) => lane)).toEqual([0, 1, 2, 3]);
  });
});

describe("compareMoments", () => {
  it("finds nothing between a moment and itself, and the turned difference the other way", () => {
    for (const [from, to] of [[20, 20], [10, 60], [60, 119]]) {
      const [a, b] = [mapAt(history, from), mapAt(history, to)];
      const there = compareMoments(history, a, b);
      const back = compareMoments(history, b, a);
      if (from === to) expect([there.newKeyframes, there.movedKeyframes, there.places.size, there.objects.size]).toEqual([[], [], 0, 0]);
      expect(there.newKeyframes.length).toBe(b.keyframeCount - a.keyframeCount);
      const turned = { new: "gone", gone: "new", joined: "new", moved: "moved", changed: "changed" } as const;
      expect(new Map([...there.places].map(([place, change]) => [place, turned[change]]))).toEqual(back.places);
      for (const [place, change] of there.places) {
        expect(change === "new").toBe(a.standsAs[place] !== place && b.standsAs[place] === place);
        expect(change === "gone").toBe(a.standsAs[place] === place && b.standsAs[place] !== place);
      }
    }
  });
});

describe("objects", () => {
  const { length } = history.objectIds;
  const relocating = {
    ...history,
    eventKinds: ["keyframe", "object_moved"],
    events: { ...history.events, offset: new Int32Array(length).fill(60), kind: new Uint8Array(length).fill(1), ref: Int32Array.from({ length }, (_, object) => object) },
  };
  const [a, b] = [mapAt(history, 40), mapAt(history, 119)];
  it("moved where the fold relocated them by more than both errors, the farthest first", () => {
    const { objects, shifts } = compareMoments(relocating, a, b);
    const { x, y } = history.changes;
    const moved = [...Array(length).keys()].filter((object) => {
      const [was, is] = [a.objectRow[object], b.objectRow[object]];
      return was >= 0 && is >= 0 && was !== is && (x[is] - x[was]) ** 2 + (y[is] - y[was]) ** 2 > 2 * 9.21;
    });
    expect(moved.length).toBeGreaterThan(0);
    expect([...objects].filter(([, change]) => change === "moved").map(([object]) => object)).toEqual(moved);
    const far = shifts.map(({ x0, y0, x1, y1 }) => Math.hypot(x1 - x0, y1 - y0));
    expect(far).toEqual([...far].sort((one, other) => other - one));
    expect(compareMoments(history, a, b).shifts).toEqual([]);
  });
  it("joined another one, rather than gone", () => {
    const { objects } = compareMoments(history, a, b);
    const absorbed = new Set(history.objectMerges.absorbed);
    const ended = [...objects].filter(([, change]) => change === "gone" || change === "joined");
    expect(ended.length).toBeGreaterThan(0);
    for (const [object, change] of ended) expect(change === "joined").toBe(absorbed.has(object));
  });
  it("are shown when they are confirmed, or all when all are asked for", () => {
    expect(shownObjects(history, b, true)).toEqual(b.objects);
    const shown = shownObjects(history, b, false);
    expect(shown).toEqual(b.objects.filter((object) => history.changes.confirmed[b.objectRow[object]] === 1));
    expect(objectsText(history, b)).toBe(`${shown.length} objects + ${b.objects.length - shown.length} seen once`);
  });
});

describe("names", () => {
  it("finds each keyframe by its name, with a slash or a colon", () => {
    for (let each = 0; each < history.keyframes.offset.length; each += 5) {
      const id = keyframeId(history, each);
      expect(findKeyframe(history, id)).toBe(each);
      expect(findKeyframe(history, id.replace("/", ":"))).toBe(each);
    }
    expect(findKeyframe(history, "a/99999")).toBe(-1);
    expect(findKeyframe(history, "a/-1")).toBe(-1);
    expect(findKeyframe(history, `a/${"9".repeat(40)}`)).toBe(-1);
    expect(findKeyframe(history, "<script>")).toBe(-1);
  });
  it("shortens by characters, not by halves of them, and shows control characters", () => {
    expect(label("☕🤖".repeat(40), 5)).toBe("☕🤖☕🤖…");
    expect(label("a\u0000b\nc")).toBe("a\ufffdb\ufffdc");
    expect(label("x".repeat(256)).length).toBe(28);
  });
  it("searches places, also by their type of room, and keyframes", () => {
    const map = mapAt(history, history.through);
    const types = new Map([[history.placeIds[map.places[1]], { type: "kitchen" }]]);
    const found = (typed: string) => searchLocally(history, map, types, typed).map(({ thing }) => thing);
    expect(found("p0")[0]).toEqual({ kind: "place", id: "r_p0" });
    expect(found("Kitchen")).toEqual([{ kind: "place", id: history.placeIds[map.places[1]] }]);
    expect(found(keyframeId(history, 3))[0]).toEqual({ kind: "keyframe", id: keyframeId(history, 3) });
    expect(found("  ")).toEqual([]);
  });
  it("tells answers apart by room, count, time and id", () => {
    const map = mapAt(history, history.through);
    const found = { object_id: "obj-0123456789", class_name: "chair", place_id: history.placeIds[map.places[0]], place_name: null, place_type: "kitchen", obs_count: 12, last_seen: { iso: "2026-03-24T13:05:09Z" }, missing_in: "r" };
    expect(foundHit(history, found)).toEqual({
      thing: { kind: "object", id: "obj-0123456789" },
      title: "chair",
      more: `kitchen ${shortPlace(history, map.places[0])} · missing in r · seen 12 times · last 2026-03-24 13:05 · obj-012345`,
      from: null,
    });
  });
});

describe("colours", () => {
  it("differ for places that were adjacent or became one", () => {
    const colours = placeColours(history, 10);
    const near = new Map<number, Set<number>>();
    const pairs = [...history.pairs.a.keys()].map((row) => [history.pairs.a[row], history.pairs.b[row]]);
    pairs.push(...[...history.merges.survivor.keys()].map((row) => [history.merges.survivor[row], history.merges.absorbed[row]]));
    for (const [a, b] of pairs) near.set(a, (near.get(a) ?? new Set()).add(b));
    for (const [a, b] of pairs) if ((near.get(a)?.size ?? 0) < 9) expect(colours[a]).not.toBe(colours[b]);
  });
});

describe("completions", () => {
  const functions = [
    { name: "size", signature: "size(place)", parameters: ["place"], result: "a number", says: "" },
    { name: "same_place", signature: "same_place(keyframe, keyframe)", parameters: ["keyframe", "keyframe"], result: "", says: "" },
    { name: "place_count", signature: "place_count()", parameters: [], result: "a number", says: "" },
  ];
  const titles = (text: string) => completions(text, text.length, functions, history).map((each) => each.title);
  const completed = (text: string) => {
    const [first] = completions(text, text.length, functions, history);
    return text.slice(0, first.from) + first.insert;
  };
  it("offers functions, then names of the kind that the argument takes", () => {
    expect(titles("s")).toEqual(["size(place)", "same_place(keyframe, keyframe)"]);
    expect(titles("not pl")).toEqual(["place_count()"]);
    expect(titles("place_count() > 3 an")).toEqual(["and"]);
    expect(completed("size('r_p")).toBe("size('r_p0')");
    expect(completed("same_place('a:")).toMatch(/^same_place\('a:\d+', '$/);
    expect(completed(`${completed("same_place('a:")}b`)).toMatch(/^same_place\('a:\d+', 'b:\d+'\)$/);
    expect(titles("size('r_p0') >")).toEqual([]);
  });
  it("escapes quotes and backslashes in names, and finds them as they were escaped", () => {
    const name = `'"\\ O'Brien`;
    const hostile = { ...history, placeIds: [name] };
    const [first] = completions("size('O", 7, functions, hostile);
    const text = `size('${first.insert}`;
    expect(text).toBe(`size('\\'"\\\\ O\\'Brien')`);
    expect(quoted(name)).toBe(text.slice(5, -1));
    expect(completions(text, text.length - 3, functions, hostile).map(({ title }) => title)).toEqual([name]);
    expect(completions(`${text} `, text.length + 1, functions, hostile).map(({ title }) => title)).not.toContain(name);
  });
});

describe("escaped", () => {
  it("leaves no markup and nothing that XML forbids", () => {
    expect(escaped(`<script>"'&`)).not.toMatch(/[<>"']|&(?!#\d+;)/);
    expect(escaped("\u0000\u0007")).toBe("\ufffd\ufffd");
  });
});
