/** The keys, in a dialog. */

import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { Icon } from "./icons";

export const helpOpen = signal(false);

const KEYS: [string, string][] = [
  ["space", "play and pause"],
  ["← →", "one event back or on"],
  ["Shift ← →", "to the change before or after"],
  ["M, Shift M", "to the next or previous merge"],
  ["↑ ↓", "through the changes that Compare lists"],
  ["Home, End", "to the beginning or the end of the log"],
  ["L", "follow the end of the log"],
  ["/", "search"],
  ["1 … 5", "Why, Compare, Find, Lost, Correct"],
  ["F", "show the whole map"],
  ["+ −", "zoom in and out"],
  ["Alt ← ↑ → ↓", "move the map"],
  ["C", "copy the command line of this view"],
  ["T", "light or dark colours"],
  ["Esc", "close, then select nothing"],
];

export function Help() {
  const ref = useRef<HTMLDialogElement>(null);
  const open = helpOpen.value;
  useEffect(() => {
    if (open) ref.current?.showModal();
    else ref.current?.close();
  }, [open]);
  return (
    <dialog ref={ref} class="help" aria-labelledby="help-title" onClose={() => (helpOpen.value = false)}>
      <header>
        <h2 id="help-title">Keys and pointer</h2>
        <button class="icon" type="button" aria-label="Close" onClick={() => (helpOpen.value = false)}>
          <Icon name="close" />
        </button>
      </header>
      <dl>
        {KEYS.map(([key, says]) => (
          <div key={key}>
            <dt>
              <kbd>{key}</kbd>
            </dt>
            <dd>{says}</dd>
          </div>
        ))}
      </dl>
      <p>
        Drag the map to move it, turn the wheel to zoom, click a thing to select it, right-click it for what can be
        done with it. Drag in the timeline to go through time; a click on a mark shows the moment after it. The map at
        moment N is the map after the first N events, as for <code>mapfold state --at N</code>.
      </p>
    </dialog>
  );
}
