/** Corrections that fit a thing, from the context menu to the form of the panel. */

import { batch, signal } from "@preact/signals";
import { openPanel } from "../state/actions";
import * as store from "../state/store";

/** A correction of this kind and its arguments, as on the command line of `mapfold edit`. */
export interface Proposal {
  kind: string;
  arguments: string[];
}

export interface Parameter {
  name: string;
  takes: "place" | "object" | "run" | "offset" | "text" | "command";
}

export const KINDS: Record<string, { says: string; parameters: Parameter[] }> = {
  "name-place": { says: "Rename a place", parameters: [{ name: "Place", takes: "place" }, { name: "Name", takes: "text" }] },
  "keep-apart": { says: "Keep two places apart", parameters: [{ name: "Place", takes: "place" }, { name: "Other place", takes: "place" }] },
  "undo-merge": { says: "Undo a merge", parameters: [{ name: "Offset of the merge", takes: "offset" }] },
  join: { says: "Join two places", parameters: [{ name: "Place", takes: "place" }, { name: "Other place", takes: "place" }] },
  "same-object": { says: "Two objects are one", parameters: [{ name: "Object", takes: "object" }, { name: "Other object", takes: "object" }] },
  "different-objects": { says: "Two objects are not one", parameters: [{ name: "Object or det_id", takes: "object" }, { name: "Other object or det_id", takes: "object" }] },
  "drop-object": { says: "Leave an object out", parameters: [{ name: "Object", takes: "object" }] },
  relabel: { says: "Rename a class", parameters: [{ name: "Class=new name", takes: "text" }] },
  "forget-run": { says: "Forget a run", parameters: [{ name: "Run", takes: "run" }] },
  undo: { says: "Undo a correction", parameters: [{ name: "Command id", takes: "command" }] },
};

export const proposal = signal<Proposal | null>(null);

/** How often a correction was proposed: each time its form takes the focus. */
export const proposed = signal(0);

/** Whether the form shows at once what the proposal would change. */
export const previewed = signal(false);

export function propose(wanted: Proposal, preview = false) {
  batch(() => {
    proposal.value = wanted;
    previewed.value = preview;
    proposed.value++;
    openPanel("correct");
  });
}

interface Offered {
  says: string;
  proposal: Proposal;
}

/** What the context menu of a thing offers; nothing where the server takes no corrections. */
export function correctionsFor(thing: store.Thing): Offered[] {
  if (!(store.log.value?.edits_allowed ?? false)) return [];
  const offer = (says: string, kind: string, ...given: string[]): Offered => ({ says, proposal: { kind, arguments: given } });
  switch (thing.kind) {
    case "place":
      return [
        offer("Rename this place …", "name-place", thing.id, ""),
        offer("Keep apart from another place …", "keep-apart", thing.id, ""),
        offer("Join with another place …", "join", thing.id, ""),
      ];
    case "object":
      return [
        offer("Same as another object …", "same-object", thing.id, ""),
        offer("Not the same as another object …", "different-objects", thing.id, ""),
        offer("Leave this object out …", "drop-object", thing.id),
      ];
    case "keyframe":
      return [offer("Forget the run of this keyframe …", "forget-run", thing.id.replace(/\/[^/]*$/, ""))];
    case "merge":
      return [offer("Undo this merge …", "undo-merge", thing.id)];
  }
}
