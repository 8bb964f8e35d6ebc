/** What can be done with the thing under the pointer. */

import { useEffect, useRef } from "preact/hooks";
import { isSaved } from "../api/saved";
import { correctionsFor, propose } from "../panels/proposals";
import { copy } from "../panels/AnswerParts";
import { openPanel, select } from "../state/actions";
import { menu } from "../state/pointer";
import * as store from "../state/store";
import { moveInMenu } from "./menu_keys";

export function ContextMenu() {
  const ref = useRef<HTMLDivElement>(null);
  const open = menu.value;
  useEffect(() => {
    if (open === null) return undefined;
    ref.current?.querySelector("button")?.focus();
    const close = (event: Event) => {
      if (!(event.target instanceof Node) || !ref.current?.contains(event.target)) menu.value = null;
    };
    document.addEventListener("pointerdown", close, true);
    return () => document.removeEventListener("pointerdown", close, true);
  }, [open]);
  if (open === null) return null;
  const { thing } = open;
  const items: [string, () => void][] = [];
  if (thing !== null) {
    items.push(["Why is it so?", () => select(thing, true)]);
    items.push([`Copy the id of this ${thing.kind}`, () => void copy(thing.id, "the id")]);
    if (thing.kind === "keyframe" && !isSaved) {
      items.push(["Where would a robot be that sees this?", () => { select(thing); openPanel("lost"); }]);
    }
  }
  if (thing !== null && (thing.kind === "place" || thing.kind === "object") && !isSaved) {
    items.push(["Way from here to what I click next", () => { select(null); store.wayFrom.value = thing.id; openPanel("why"); }]);
  }
  items.push(["Compare from this moment", () => { store.compareWith.value = store.at.value; store.compareMode.value = "moments"; openPanel("compare"); }]);
  const corrections = thing === null || isSaved ? [] : correctionsFor(thing);
  const keys = (event: KeyboardEvent) => {
    if (event.key === "Escape" || event.key === "Tab") {
      menu.value = null;
      event.stopPropagation();
    } else moveInMenu(event, ref.current);
  };
  const item = (says: string, act: () => void) => (
    <button key={says} type="button" role="menuitem" onClick={() => { menu.value = null; act(); }}>
      {says}
    </button>
  );
  const [left, top] = [Math.min(open.x, window.innerWidth - 270), Math.min(open.y, window.innerHeight - 34 * (items.length + corrections.length + 1))];
  return (
    <div ref={ref} class="menu" role="menu" aria-label="What to do" style={{ left: `${left}px`, top: `${Math.max(8, top)}px` }} onKeyDown={keys}>
      {items.map(([says, act]) => item(says, act))}
      {corrections.length > 0 && <hr />}
      {corrections.map((each) => item(each.says, () => propose(each.proposal)))}
    </div>
  );
}
