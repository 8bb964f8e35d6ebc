/** Compares two moments, or two settings. */

import { isSaved } from "../api/saved";
import type { CompareMode } from "../state/store";
import * as store from "../state/store";
import { CompareMoments } from "./CompareMoments";
import { CompareSettings } from "./CompareSettings";

const MODES: [CompareMode, string][] = [
  ["moments", "Two moments"],
  ["settings", "Two settings"],
];

export function Compare() {
  const mode = store.compareMode.value;
  return (
    <section class="story">
      {!isSaved && <fieldset class="segments wide">
        <legend class="hidden">What to compare</legend>
        {MODES.map(([each, says]) => (
          <label key={each} class={mode === each ? "on" : ""}>
            <input type="radio" name="compare" checked={mode === each} onChange={() => (store.compareMode.value = each)} />
            {says}
          </label>
        ))}
      </fieldset>}
      {mode === "moments" || isSaved ? <CompareMoments /> : <CompareSettings />}
    </section>
  );
}
