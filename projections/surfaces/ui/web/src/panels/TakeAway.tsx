/** Takes the view away: PNG, SVG, the state as JSON, or the command line that gives the same. */

import { useEffect, useRef } from "preact/hooks";
import { signal } from "@preact/signals";
import { currentScene } from "../map/current_scene";
import { paint } from "../map/paint";
import { SvgSurface } from "../map/surface";
import { stateDocument } from "../model/document";
import { showNotice } from "../state/pointer";
import { writtenAddress } from "../state/url";
import * as store from "../state/store";
import { Icon } from "../ui/icons";
import { moveInMenu } from "../ui/menu_keys";
import { copy } from "./AnswerParts";

const open = signal(false);

export function TakeAway() {
  const ref = useRef<HTMLDivElement>(null);
  const shown = open.value;
  useEffect(() => {
    if (!shown) return undefined;
    ref.current?.querySelector<HTMLButtonElement>("[role=menuitem]")?.focus();
    const close = (event: Event) => {
      const outside = !(event.target instanceof Node) || !ref.current?.contains(event.target);
      const key = event instanceof KeyboardEvent ? event.key : null;
      if (outside || key === "Tab") open.value = false;
      if (key === "Escape") {
        open.value = false;
        event.stopPropagation();
        ref.current?.querySelector("button")?.focus();
      }
    };
    document.addEventListener("pointerdown", close, true);
    document.addEventListener("keydown", close, true);
    return () => {
      document.removeEventListener("pointerdown", close, true);
      document.removeEventListener("keydown", close, true);
    };
  }, [shown]);
  const item = (says: string, act: () => void | Promise<void>) => (
    <button type="button" role="menuitem" onClick={() => { open.value = false; void act(); }}>
      {says}
    </button>
  );
  return (
    <div class="take" ref={ref}>
      <button type="button" class="icon" aria-label="Take away" title="Take away: picture, JSON, command" aria-haspopup="menu" aria-expanded={shown} onClick={() => (open.value = !shown)}>
        <Icon name="out" />
      </button>
      {shown && (
        <div class="menu" role="menu" aria-label="Take away" onKeyDown={(event) => moveInMenu(event, ref.current)}>
          {item("Picture as PNG", savePng)}
          {item("Picture as SVG", saveSvg)}
          {item("State as JSON", saveJson)}
          {item("Copy as command", copyCommand)}
          {item("Copy the link to this view", () => copy(location.href.replace(/#.*$/, "") + writtenAddress(true), "the link"))}
        </div>
      )}
    </div>
  );
}

function fileName(suffix: string): string {
  return `${(store.log.value?.name ?? "map").replace(/[^\w.-]+/g, "_").slice(0, 60)}-${store.at.value}.${suffix}`;
}

function save(blob: Blob, suffix: string) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = fileName(suffix);
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  showNotice(`Saved ${link.download}.`);
}

function savePng(): Promise<void> {
  const canvas = document.querySelector<HTMLCanvasElement>("canvas.map");
  return new Promise((resolve) => {
    canvas?.toBlob((blob) => {
      if (blob === null) showNotice("Too large for a PNG; take the SVG.");
      else save(blob, "png");
      resolve();
    }, "image/png");
  });
}

function saveSvg() {
  const canvas = document.querySelector<HTMLCanvasElement>("canvas.map");
  if (canvas === null) return;
  const scene = currentScene("main", canvas.clientWidth, canvas.clientHeight);
  if (scene === null) return;
  const ruler = document.createElement("canvas").getContext("2d") as CanvasRenderingContext2D;
  const surface = new SvgSurface(scene.width, scene.height, (font, text) => {
    ruler.font = font;
    return ruler.measureText(text).width;
  });
  paint(surface, scene);
  save(new Blob([surface.document(scene.palette.ground)], { type: "image/svg+xml" }), "svg");
}

function saveJson() {
  const [history, map] = [store.history.value, store.map.value];
  if (history === null || map === null) return;
  const text = JSON.stringify(stateDocument(history, map, store.mapFactsNow.value), null, 1);
  save(new Blob([`${text}\n`], { type: "application/json" }), "json");
}

/** The command line of the panel's answer, or of the map at W. */
export function copyCommand(): Promise<void> {
  const answer = document.querySelector("#panel .command code")?.textContent;
  const shown = store.stateCommand.value;
  const state = shown?.at === store.at.value ? shown.command : null;
  if (answer === undefined && state === null) {
    showNotice("The command of this moment is not here yet; try again.");
    return Promise.resolve();
  }
  return copy(answer ?? state ?? "", "the command line");
}
