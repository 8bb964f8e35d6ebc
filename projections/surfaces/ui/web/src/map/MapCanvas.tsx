/** A map on a canvas: drawn once a frame when something changed; pan, zoom, hover, select. */

import { effect } from "@preact/signals";
import { select as d3select } from "d3-selection";
import { type D3ZoomEvent, type ZoomBehavior, zoom, zoomIdentity } from "d3-zoom";
import { useEffect, useRef } from "preact/hooks";
import { select } from "../state/actions";
import { lostPoint, shownBridge, shownLost, shownWay } from "../state/overlays";
import { walls } from "../state/walls";
import { markTip, menu, tip } from "../state/pointer";
import { type Grip, byDragging, dragged, dropped } from "../panels/drag_edits";
import { propose } from "../panels/proposals";
import { shownObjects } from "../model/map_at";
import * as store from "../state/store";
import { summary } from "../ui/summary";
import { type Side, currentScene } from "./current_scene";
import { DotLayer } from "./dots";
import type { Box } from "./labels";
import { dotRadius } from "./keyframes";
import { paint } from "./paint";
import { DARK, LIGHT } from "./palette";
import { type Picked, pick } from "./pick";
import type { Bounds } from "../model/regions";
import { type View, filled, fitted, mapX, mapY } from "./view";

type Zoomed = ZoomBehavior<HTMLCanvasElement, unknown>;

/** Called after a frame of the main map is drawn. */
export const painted = new Set<() => void>();
let moved = false;
/** The part of the map that a link asked for, as long as nobody moves it. */
let wanted: Bounds | null = null;

/** What the counts at the top left cover: a column, on a phone a row. */
const FACTS_WIDE_PX = 248;
/** The buttons at the bottom right. */
const ZOOM_WIDE_PX = 48;
const FACTS_HIGH_PX = 44;
const NARROW_PX = 520;

/** What lies over a map. */
const CONTROLS = ".facts, .zoom, .scale, .pane-title";

/** How far a pointer moves until it drags. */
const DRAG_PIXELS = 4;

/** The view that shows the whole map. */
export function fitView() {
  const canvas = document.querySelector<HTMLCanvasElement>("canvas.map");
  const bounds = store.drawnBounds.value;
  if (canvas === null || bounds === null || canvas.clientWidth === 0) return;
  moved = false;
  wanted = null;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  store.view.value = width <= NARROW_PX ? fitted(bounds, width, height, 0, FACTS_HIGH_PX) : fitted(bounds, width, height, FACTS_WIDE_PX, 0, ZOOM_WIDE_PX);
}

/** What the canvas shows of the map, metres; null for the whole map. */
export function viewBox(): Bounds | null {
  const canvas = document.querySelector<HTMLCanvasElement>("canvas.map");
  const view = store.view.value;
  if (canvas === null || view === null || !moved) return null;
  if (wanted !== null) return wanted;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  return { x0: mapX(view, 0), y0: mapY(view, h), x1: mapX(view, w), y1: mapY(view, 0) };
}

/** Shows a part of the map; null for all of it. */
export function showBox(box: Bounds | null) {
  const canvas = document.querySelector<HTMLCanvasElement>("canvas.map");
  if (box === null) fitView();
  else if (canvas !== null) {
    moved = true;
    wanted = box;
    store.view.value = filled(box, canvas.clientWidth, canvas.clientHeight);
  }
}

/** A person moves the view. */
function move(view: View) {
  moved = true;
  wanted = null;
  store.view.value = view;
}

/** Zooms about the middle, or moves by pixels. */
export function changeView(factor: number, dx = 0, dy = 0) {
  const canvas = document.querySelector<HTMLCanvasElement>("canvas.map");
  const view = store.view.value;
  if (canvas === null || view === null) return;
  const [cx, cy] = [canvas.clientWidth / 2, canvas.clientHeight / 2];
  move({
    k: view.k * factor,
    x: cx + (view.x - cx) * factor + dx,
    y: cy + (view.y - cy) * factor + dy,
  });
}

/** Moves the view so that a point of the map is in the middle, unless it is well inside already. */
export function bringIntoView(x: number, y: number) {
  const canvas = document.querySelector<HTMLCanvasElement>("canvas.map");
  const view = store.view.value;
  if (canvas === null || view === null) return;
  const [sx, sy] = [x * view.k + view.x, view.y - y * view.k];
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  if (sx > 60 && sy > 60 && sx < w - 60 && sy < h - 60) return;
  move({ k: view.k, x: view.x + w / 2 - sx, y: view.y + h / 2 - sy });
}

export function MapCanvas({ side }: { side: Side }) {
  const ref = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    const canvas = ref.current as HTMLCanvasElement;
    const stops = [keepDrawn(canvas, side), keepZoomed(canvas), followPointer(canvas, side)];
    return () => stops.forEach((stop) => stop());
  }, [side]);
  const text = summary(side === "main" ? store.restedMap.value : store.other.value.map, store.history.value);
  return <canvas ref={ref} class="map" role="img" aria-label={text} data-side={side} />;
}

function keepDrawn(canvas: HTMLCanvasElement, side: Side): () => void {
  const context = canvas.getContext("2d", { alpha: false }) as CanvasRenderingContext2D;
  const dots = new DotLayer();
  let frame = 0;
  let width = 0;
  const draw = () => {
    frame = 0;
    const ratio = window.devicePixelRatio || 1;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    if (w === 0 || h === 0) return;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
    }
    const palette = store.dark.value ? DARK : LIGHT;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = palette.ground;
    context.fillRect(0, 0, w, h);
    const scene = currentScene(side, w, h);
    if (scene !== null) {
      scene.controls = controlsOver(canvas);
      scene.dots = () => {
        const radius = dotRadius(scene.view.k) * 0.8;
        const layer = dots.draw(scene.history, scene.map, scene.view, palette, canvas.width, canvas.height, ratio, radius);
        context.setTransform(1, 0, 0, 1, 0, 0);
        context.drawImage(layer, 0, 0);
        context.setTransform(ratio, 0, 0, ratio, 0, 0);
      };
      paint(context, scene);
    }
    if (side === "main") for (const each of painted) each();
  };
  const schedule = () => {
    if (frame === 0) frame = requestAnimationFrame(draw);
  };
  const observer = new ResizeObserver(() => {
    const now = canvas.clientWidth;
    const view = store.view.value;
    if (side === "main" && now > 0) {
      if (view === null || !moved) fitView();
      else if (wanted !== null) showBox(wanted);
      else if (width > 0) store.view.value = { ...view, x: view.x + (now - width) / 2 };
    }
    width = now;
    schedule();
  });
  observer.observe(canvas);
  const controls = new ResizeObserver(schedule); // labels stand beside them
  for (const each of document.querySelectorAll(CONTROLS)) controls.observe(each);
  const stopFitting = effect(() => {
    if (side === "main" && store.drawnBounds.value !== null && !moved) queueMicrotask(() => moved || fitView());
  });
  const stop = effect(() => {
    for (const each of inputs()) void each.value;
    schedule();
  });
  return () => {
    observer.disconnect();
    controls.disconnect();
    stop();
    stopFitting();
    cancelAnimationFrame(frame);
  };
}

/** Where counts, buttons and the scale are over a map. */
function controlsOver(canvas: HTMLCanvasElement): Box[] {
  const { left, top } = canvas.getBoundingClientRect();
  return [...document.querySelectorAll(CONTROLS)].map((control) => {
    const { x, y, width, height } = control.getBoundingClientRect();
    return { x: x - left - 3, y: y - top - 3, width: width + 6, height: height + 6 };
  });
}

/** The signals that a drawing depends on; the map itself is computed once a frame, in it. */
function inputs() {
  return [
    store.at, store.view, store.layers, store.selection, store.hovered, store.found, store.dark, store.log,
    store.history, store.otherHistory, store.otherFacts,
    store.panel, store.compareMode, store.compareWith, shownBridge, shownLost, shownWay, store.floor, store.mapFacts, walls, dragged,
  ];
}

function keepZoomed(canvas: HTMLCanvasElement): () => void {
  const behaviour: Zoomed = zoom<HTMLCanvasElement, unknown>()
    .scaleExtent([0.02, 4000])
    .clickDistance(4)
    .duration(0)
    .filter((event: MouseEvent) => !event.button && !(event.ctrlKey && event.type !== "wheel") && dragged.value === null)
    .on("zoom", ({ transform, sourceEvent }: D3ZoomEvent<HTMLCanvasElement, unknown>) => {
      if (sourceEvent === null) return;
      move({ k: transform.k, x: transform.x, y: transform.y });
    });
  const selected = d3select(canvas).call(behaviour).on("dblclick.zoom", null); // it would animate
  const stop = effect(() => {
    const view = store.view.value;
    if (view !== null) selected.property("__zoom", zoomIdentity.translate(view.x, view.y).scale(view.k));
  });
  return () => {
    stop();
    selected.on(".zoom", null);
  };
}

function followPointer(canvas: HTMLCanvasElement, side: Side): () => void {
  const at = (event: MouseEvent): Picked | null => {
    const shown = side === "main" ? store.shown.value : store.otherShown.value;
    const view = store.view.value;
    if (shown === null || view === null) return null;
    const regions = side === "main" ? store.regions.value : store.otherRegions.value;
    const box = canvas.getBoundingClientRect();
    const { objects, once } = store.layers.value;
    const found = objects ? shownObjects(shown.history, shown.map, once) : [];
    return pick(shown.history, shown.map, regions, view, event.clientX - box.left, event.clientY - box.top, found);
  };
  const move = (event: PointerEvent) => {
    if (event.buttons !== 0) return;
    const found = at(event);
    canvas.classList.toggle("over-thing", found !== null);
    store.hovered.value = found?.thing ?? null;
    tip.value = found === null ? null : { x: event.clientX, y: event.clientY, side, ...found };
  };
  const leave = () => {
    store.hovered.value = null;
    tip.value = null;
  };
  let from: Grip | null = null;
  let wasDrag = false;
  const grip = (event: MouseEvent): Grip | null => {
    const [picked, view, box] = [at(event), store.view.value, canvas.getBoundingClientRect()];
    return picked === null || view === null ? null : { picked, x: mapX(view, event.clientX - box.left), y: mapY(view, event.clientY - box.top) };
  };
  const down = (event: PointerEvent) => {
    wasDrag = false;
    if (event.button !== 0 || side !== "main" || !byDragging.value || store.panel.value !== "correct") return;
    from = grip(event);
    if (from === null) return;
    dragged.value = { x0: from.x, y0: from.y, x1: from.x, y1: from.y };
    canvas.setPointerCapture(event.pointerId);
  };
  const proposed = (event: MouseEvent) => {
    const [history, map] = [store.history.value, store.map.value];
    return from === null || history === null || map === null || !wasDrag ? null : dropped(history, map, from, grip(event));
  };
  const drag = (event: PointerEvent) => {
    const [line, view, box] = [dragged.value, store.view.value, canvas.getBoundingClientRect()];
    if (line === null || view === null) return;
    const [x1, y1] = [mapX(view, event.clientX - box.left), mapY(view, event.clientY - box.top)];
    wasDrag ||= Math.hypot(x1 - line.x0, y1 - line.y0) * view.k > DRAG_PIXELS;
    dragged.value = { ...line, x1, y1 };
    tip.value = null;
    store.hovered.value = at(event)?.thing ?? null;
    const says = proposed(event)?.says;
    markTip.value = says === undefined ? null : { x: event.clientX, y: event.clientY, lines: [says] };
  };
  const up = (event: PointerEvent) => {
    const found = event.type === "pointerup" ? proposed(event) : null;
    if (dragged.value !== null) dragged.value = markTip.value = null;
    from = null;
    if (found !== null) propose(found.proposal(), true);
  };
  const click = (event: MouseEvent) => {
    menu.value = null;
    if (wasDrag) return;
    if (store.panel.value === "lost" && store.view.value !== null) {
      const box = canvas.getBoundingClientRect();
      lostPoint.value = { x: mapX(store.view.value, event.clientX - box.left), y: mapY(store.view.value, event.clientY - box.top) };
    } else select(at(event)?.thing ?? null, true);
  };
  const context = (event: MouseEvent) => {
    event.preventDefault();
    const found = at(event);
    tip.value = null;
    if (found !== null) select(found.thing);
    menu.value = { x: event.clientX, y: event.clientY, thing: found?.thing ?? null };
  };
  canvas.addEventListener("pointerdown", down);
  canvas.addEventListener("pointermove", drag);
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("pointermove", move);
  canvas.addEventListener("pointerleave", leave);
  canvas.addEventListener("click", click);
  canvas.addEventListener("contextmenu", context);
  return () => {
    canvas.removeEventListener("pointerdown", down);
    canvas.removeEventListener("pointermove", drag);
    canvas.removeEventListener("pointerup", up);
    canvas.removeEventListener("pointercancel", up);
    canvas.removeEventListener("pointermove", move);
    canvas.removeEventListener("pointerleave", leave);
    canvas.removeEventListener("click", click);
    canvas.removeEventListener("contextmenu", context);
  };
}
