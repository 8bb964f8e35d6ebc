/** The panel beside the map: one of five questions. */

import { openPanel } from "../state/actions";
import * as store from "../state/store";
import { Icon } from "../ui/icons";
import { Compare } from "./Compare";
import { Correct } from "./Correct";
import { Find } from "./Find";
import { Lost } from "./Lost";
import { Why } from "./Why";

const TITLES: Record<store.PanelName, [string, string]> = {
  why: ["Why", "What happened to a thing, and why places merged"],
  compare: ["Compare", "Two moments, or two settings"],
  find: ["Find", "The event that made a condition true"],
  lost: ["Lost", "Where is a robot that sees these things?"],
  correct: ["Correct", "Corrections of the map"],
};
const BODIES = { why: Why, compare: Compare, find: Find, lost: Lost, correct: Correct };

export function SidePanel() {
  const shown = store.panel.value;
  const Body = shown === null ? null : BODIES[shown];
  const turn = (event: KeyboardEvent) => {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (by === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    const at = shown === null ? 0 : store.PANELS.indexOf(shown);
    const next = store.PANELS[(at + by + store.PANELS.length) % store.PANELS.length];
    openPanel(next);
    document.getElementById(`tab-${next}`)?.focus();
  };
  return (
    <aside class="side" aria-label="Questions about the map">
      <div class="tabs">
        <div role="tablist" aria-label="Questions" onKeyDown={turn}>
          {store.PANELS.map((name, index) => (
            <button
              key={name}
              id={`tab-${name}`}
              type="button"
              role="tab"
              title={`${TITLES[name][1]} (${index + 1})`}
              aria-selected={shown === name}
              aria-controls="panel"
              tabIndex={shown === name || (shown === null && index === 0) ? 0 : -1}
              onClick={() => openPanel(name)}
            >
              {TITLES[name][0]}
            </button>
          ))}
        </div>
        {shown !== null && (
          <button class="icon" type="button" aria-label="Close the panel" title="Close the panel" onClick={() => openPanel(null)}>
            <Icon name="close" />
          </button>
        )}
      </div>
      <div id="panel" class="panel" role="tabpanel" aria-labelledby={shown === null ? undefined : `tab-${shown}`} tabIndex={0} hidden={shown === null}>
        {Body !== null && <Body />}
      </div>
    </aside>
  );
}
