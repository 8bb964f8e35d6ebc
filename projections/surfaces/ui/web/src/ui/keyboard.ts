/** Keys of the whole page. */

import { changeView, fitView } from "../map/MapCanvas";
import { walkChanges } from "../panels/CompareMoments";
import { copyCommand } from "../panels/TakeAway";
import { goLive, goTo, openPanel, select, stepBy, togglePlay } from "../state/actions";
import { menu } from "../state/pointer";
import * as store from "../state/store";
import { helpOpen } from "./Help";
import { focusSearch } from "./Search";
import { toggleTheme } from "./TopBar";

const PAN_PIXELS = 60;
const PAN: Record<string, [number, number]> = {
  ArrowLeft: [PAN_PIXELS, 0],
  ArrowRight: [-PAN_PIXELS, 0],
  ArrowUp: [0, PAN_PIXELS],
  ArrowDown: [0, -PAN_PIXELS],
};

export function keepKeys() {
  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || event.ctrlKey || event.metaKey || document.querySelector("dialog[open]")) return;
    if (isTyping(event.target) && event.key !== "Escape") return;
    if (event.target instanceof Element && event.target.closest("[role=menu]") !== null) return; // its own keys
    if (event.key === " " && event.target instanceof HTMLElement && event.target.closest("button, summary, label, [role=tab]")) return;
    if (press(event)) event.preventDefault();
  });
}

function isTyping(target: EventTarget | null): boolean {
  return target instanceof HTMLElement && target.closest("input:not([type=checkbox]):not([type=radio]), textarea, select") !== null;
}

function press({ key, shiftKey, altKey, target }: KeyboardEvent): boolean {
  if (altKey) {
    const pan = PAN[key];
    if (pan !== undefined) changeView(1, ...pan);
    return pan !== undefined;
  }
  const within = (what: string) => target instanceof HTMLElement && target.closest(what) !== null;
  switch (key) {
    case " ":
      togglePlay();
      return true;
    case "ArrowLeft":
    case "ArrowRight":
      if (within("[role=tablist], fieldset")) return false;
      stepBy(shiftKey ? "change" : "event", key === "ArrowRight" ? 1 : -1);
      return true;
    case "ArrowUp":
    case "ArrowDown":
      return store.panel.value === "compare" && !within("fieldset") && walkChanges(key === "ArrowDown" ? 1 : -1);
    case "m":
    case "M":
      stepBy("merge", shiftKey ? -1 : 1);
      return true;
    case "Home":
      goTo(0);
      return true;
    case "End":
      goTo(Number.MAX_SAFE_INTEGER);
      return true;
    case "l":
      goLive(!store.live.value);
      return true;
    case "/":
      focusSearch();
      return true;
    case "?":
      helpOpen.value = true;
      return true;
    case "f":
      fitView();
      return true;
    case "+":
    case "=":
      changeView(1.25);
      return true;
    case "-":
      changeView(0.8);
      return true;
    case "c":
      void copyCommand();
      return true;
    case "t":
      toggleTheme();
      return true;
    case "Escape":
      if (menu.value !== null) menu.value = null;
      else select(null);
      return true;
    default: {
      const panel = store.PANELS[Number(key) - 1];
      if (panel !== undefined) openPanel(panel);
      return panel !== undefined;
    }
  }
}
