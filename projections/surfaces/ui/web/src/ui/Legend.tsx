/** What the signs on the map and the timeline mean; a click hides or shows those of the map. */

import { useEffect, useRef } from "preact/hooks";
import { scaleBar } from "../map/view";
import { DARK, LIGHT } from "../map/palette";
import { MARKED } from "../model/moments";
import * as store from "../state/store";
import { KIND_NAMES, drawMark } from "../timeline/marks";

const LAYERS: [store.LayerName, string, preact.JSX.Element][] = [
  ["regions", "place", <rect x="2" y="4" width="16" height="10" rx="4" class="sign-region" />],
  ["keyframes", "keyframe / in no place", <><circle cx="6" cy="9" r="3.4" class="sign-dot" /><circle cx="15" cy="9" r="3" class="sign-hollow" /></>],
  ["path", "drive", <><path d="M2 13 Q7 3 12 8" class="sign-line" /><path d="M18 8 11 4.6 12.6 8 11 11.4z" class="sign-fill" /></>],
  ["objects", "object / missing", <><path d="M6 5l4 4-4 4-4-4z" class="sign-fill" /><path d="M15 5l4 4-4 4-4-4z" class="sign-missing" /></>],
  ["once", "object seen once", <path d="M10 5l4 4-4 4-4-4z" class="sign-faint" />],
  ["ellipses", "95 % area", <ellipse cx="10" cy="9" rx="8" ry="4.5" class="sign-hollow" />],
  ["edges", "2× drives between", <path d="M1 9H19" class="sign-dashed" />],
  ["walls", "wall", <path d="M2 14V5H18" class="sign-wall" />],
  ["labels", "name, keyframes", <text x="0" y="13" class="sign-text">p2 7</text>],
];

export function Legend() {
  const shown = store.layers.value;
  const ellipses = store.log.value?.fusion === "evidence";
  const walls = (store.log.value?.walls?.length ?? 0) > 0;
  const there = LAYERS.filter(([name]) => (name !== "ellipses" || ellipses) && (name !== "walls" || walls));
  return (
    <fieldset class="legend">
      <legend class="hidden">Legend, and what is shown</legend>
      {there.map(([name, says, sign]) => (
        <label key={name} class={shown[name] ? "" : "off"} title={shown[name] ? `Hide: ${says}` : `Show: ${says}`}>
          <input type="checkbox" class="hidden" checked={shown[name]} onChange={() => (store.layers.value = { ...shown, [name]: !shown[name] })} />
          <svg viewBox={name === "labels" ? "0 0 30 18" : "0 0 20 18"} width={name === "labels" ? "30" : "20"} height="18" aria-hidden="true">{sign}</svg>
          {says}
        </label>
      ))}
    </fieldset>
  );
}

export function MarkLegend() {
  const marks = new Set(store.moments.value?.marks.map((mark) => mark.kind));
  return (
    <ul class="kinds" aria-label="Marks on the timeline">
      {MARKED.filter((kind) => marks.has(kind)).map((kind) => (
        <li key={kind}>
          <MarkSign kind={kind} />
          {KIND_NAMES[kind]}
        </li>
      ))}
    </ul>
  );
}

function MarkSign({ kind }: { kind: (typeof MARKED)[number] }) {
  const ref = useRef<HTMLCanvasElement>(null);
  const dark = store.dark.value;
  useEffect(() => {
    const canvas = ref.current as HTMLCanvasElement;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.height = 14 * ratio;
    const on = canvas.getContext("2d") as CanvasRenderingContext2D;
    on.scale(ratio, ratio);
    drawMark(on, kind, 7, 7, dark ? DARK : LIGHT);
  }, [kind, dark]);
  return <canvas ref={ref} class="sign" aria-hidden="true" />;
}

export function ScaleBar() {
  const view = store.view.value;
  if (view === null) return null;
  const { metres, width } = scaleBar(view, 110);
  return (
    <div class="scale" aria-hidden="true">
      <span>{metres >= 1000 ? `${metres / 1000} km` : metres >= 1 ? `${metres} m` : `${Math.round(metres * 100)} cm`}</span>
      <i style={{ width: `${width}px` }} />
    </div>
  );
}
