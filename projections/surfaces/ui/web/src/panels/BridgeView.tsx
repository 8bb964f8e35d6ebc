/** A merge in pictures: the places before and after it, about the core points that linked them. */

import { useEffect, useRef } from "preact/hooks";
import type { History } from "../history/types";
import { DARK, LIGHT } from "../map/palette";
import { paint } from "../map/paint";
import type { Bridge, Scene } from "../map/scene";
import { fitted } from "../map/view";
import { type Shown, onFloor } from "../model/floors";
import { mapAt } from "../model/map_at";
import { keyframeId } from "../model/names";
import { gridOf, regionsOf } from "../model/regions";
import { walls } from "../state/walls";
import * as store from "../state/store";
import { ThingLink } from "./AnswerParts";

export interface MergeStory {
  number: number;
  offset: number;
  eps_m: number | null;
  min_samples: number | null;
  bridge: number;
  chain_points: number[][];
  chains: { distances_m: number[] }[];
  link_points: [number, number][];
  links: { distance_m: number }[];
  core: number[];
  made_core: number[];
  positions: { keyframe: number; name: string }[];
  sides: { place: number; place_id: string; keyframes: number }[];
}

/** What is drawn of the merges of an event: the chains, or the links where there are none. */
export function bridgeOf(history: History, merges: readonly MergeStory[]): Bridge {
  const { x, y } = history.keyframes;
  const chains = merges.flatMap((merge) => {
    const names = new Map(merge.positions.map(({ keyframe, name }) => [keyframe, name]));
    const made = new Set(merge.made_core);
    const lines: [number[], number[]][] =
      merge.chain_points.length > 0
        ? merge.chain_points.map((points, index) => [points, merge.chains[index]?.distances_m ?? []])
        : merge.link_points.map((points, index) => [points, [merge.links[index]?.distance_m ?? 0]]);
    return lines.map(([points, distances]) => ({
      distances,
      points: points
        .filter((point) => !Number.isNaN(x[point]))
        .map((point) => ({ x: x[point], y: y[point], name: names.get(point) ?? "", madeCore: made.has(point) })),
    }));
  });
  return { epsM: merges[0]?.eps_m ?? 0, core: [...new Set(merges.flatMap((merge) => merge.core))], chains };
}

export function BridgeView({ merge, history }: { merge: MergeStory; history: History }) {
  const [first, ...others] = merge.sides;
  return (
    <figure class="bridge">
      <div class="pair">
        <MiniMap history={history} merge={merge} at={merge.offset} title="before" />
        <MiniMap history={history} merge={merge} at={merge.offset + 1} title="after" />
      </div>
      <figcaption>
        <ThingLink thing={{ kind: "place", id: first.place_id }} /> had {first.keyframes}
        {others.map((side) => (
          <span key={side.place}>
            , <ThingLink thing={{ kind: "place", id: side.place_id }} /> had {side.keyframes}
          </span>
        ))}{" "}
        keyframes; <ThingLink thing={{ kind: "keyframe", id: keyframeId(history, merge.bridge) }} /> linked them.{" "}
        {merge.eps_m === null
          ? "The thick line joins the nearest of their keyframes."
          : `A circle is ε = ${merge.eps_m} m; a point with ${merge.min_samples} neighbours in it, itself among them, is a core point (ringed). Blue points became core points by this event; the thick line is the chain that links the places.`}
      </figcaption>
    </figure>
  );
}

const AROUND_M = 0.4;

function MiniMap({ history, merge, at, title }: { history: History; merge: MergeStory; at: number; title: string }) {
  const ref = useRef<HTMLCanvasElement>(null);
  const dark = store.dark.value;
  useEffect(() => {
    const canvas = ref.current as HTMLCanvasElement;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const ratio = window.devicePixelRatio || 1;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const on = canvas.getContext("2d") as CanvasRenderingContext2D;
    on.setTransform(ratio, 0, 0, ratio, 0, 0);
    const scene = miniScene(onFloor({ history, map: mapAt(history, at) }, store.shownFloor.peek()), merge, width, height, dark);
    on.fillStyle = scene.palette.ground;
    on.fillRect(0, 0, width, height);
    paint(on, scene);
  }, [history, merge, at, dark]);
  return (
    <div class="mini">
      <canvas ref={ref} role="img" aria-label={`The places ${title} the merge`} />
      <span>{title}</span>
    </div>
  );
}

function miniScene({ history, map }: Shown, merge: MergeStory, width: number, height: number, dark: boolean): Scene {
  const bridge = bridgeOf(history, [merge]);
  const points = bridge.chains.flatMap((chain) => chain.points);
  const around = bridge.epsM + AROUND_M;
  const [xs, ys] = [points.map(({ x }) => x), points.map(({ y }) => y)];
  const near = {
    x0: Math.min(...xs) - around,
    x1: Math.max(...xs) + around,
    y0: Math.min(...ys) - around,
    y1: Math.max(...ys) + around,
  };
  const bounds = store.bounds.peek();
  return {
    history,
    map,
    regions: bounds === null ? null : regionsOf(history, map, gridOf(bounds), new Map()),
    view: fitted(points.length > 0 ? near : (bounds ?? near), width, height),
    palette: dark ? DARK : LIGHT,
    width,
    height,
    layers: { regions: true, path: true, keyframes: true, objects: false, once: false, ellipses: false, edges: false, walls: true, labels: true },
    walls: walls.peek(),
    types: store.rooms.peek(),
    selection: null,
    hovered: null,
    found: new Set(),
    difference: null,
    bridge,
    lost: null,
    way: null,
    drag: null,
    controls: [],
    dots: null,
  };
}
