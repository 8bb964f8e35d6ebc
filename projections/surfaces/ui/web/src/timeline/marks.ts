/** The marks above the timeline: a shape for each kind of event, and what it says. */

import type { Palette } from "../map/palette";
import type { History } from "../history/types";
import { isolated, label } from "../model/names";
import type { Mark, Marked } from "../model/moments";

export const KIND_NAMES: Record<Marked, string> = {
  place_founded: "place founded",
  place_merged: "places merged",
  merge_refused: "merge refused",
  objects_merged: "objects merged",
  object_missing: "object missing",
  object_moved: "object moved",
  correction: "correction",
  rejected: "rejected payload",
  loss: "messages lost",
  run_began: "run began",
};

/** Kinds in the upper of the two rows. */
const UPPER: ReadonlySet<Marked> = new Set(["place_merged", "merge_refused", "correction", "rejected", "loss"]);
export const ROW_HEIGHT = 14;
export const ROWS_HEIGHT = 2 * ROW_HEIGHT + 4;

export const rowOf = (kind: Marked) => (UPPER.has(kind) ? 0 : 1);

export function markColour(kind: Marked, palette: Palette): string {
  switch (kind) {
    case "place_merged":
      return palette.accent;
    case "merge_refused":
    case "rejected":
    case "loss":
      return palette.removed;
    case "correction":
      return palette.moved;
    default:
      return palette.dim;
  }
}

/** Draws the shape of a kind about (x, y), some ten pixels wide. */
export function drawMark(on: CanvasRenderingContext2D, kind: Marked, x: number, y: number, palette: Palette) {
  on.fillStyle = on.strokeStyle = markColour(kind, palette);
  on.lineWidth = 1.6;
  on.beginPath();
  switch (kind) {
    case "place_founded": // a triangle
      on.moveTo(x, y - 4.5);
      on.lineTo(x + 4.5, y + 3.5);
      on.lineTo(x - 4.5, y + 3.5);
      on.closePath();
      on.fill();
      break;
    case "place_merged": // two lines that become one
      on.moveTo(x - 4.5, y - 4.5);
      on.lineTo(x, y);
      on.lineTo(x + 4.5, y - 4.5);
      on.moveTo(x, y);
      on.lineTo(x, y + 5);
      on.lineWidth = 2.2;
      on.stroke();
      break;
    case "merge_refused": // a cross
      on.moveTo(x - 4, y - 4);
      on.lineTo(x + 4, y + 4);
      on.moveTo(x + 4, y - 4);
      on.lineTo(x - 4, y + 4);
      on.stroke();
      break;
    case "objects_merged": // two circles that overlap
      on.arc(x - 2, y, 3, 0, 7);
      on.moveTo(x + 5, y);
      on.arc(x + 2, y, 3, 0, 7);
      on.stroke();
      break;
    case "object_missing": // a hollow diamond
    case "object_moved": // a filled one
      on.moveTo(x, y - 4.5);
      on.lineTo(x + 4.5, y);
      on.lineTo(x, y + 4.5);
      on.lineTo(x - 4.5, y);
      on.closePath();
      if (kind === "object_moved") on.fill();
      else on.stroke();
      break;
    case "correction": // a flag
      on.moveTo(x - 3, y + 5);
      on.lineTo(x - 3, y - 5);
      on.lineTo(x + 4.5, y - 2);
      on.lineTo(x - 3, y + 1);
      on.stroke();
      on.fill();
      break;
    case "rejected": // a square
      on.rect(x - 3.5, y - 3.5, 7, 7);
      on.stroke();
      break;
    case "loss": // a gap
      on.moveTo(x - 5, y);
      on.lineTo(x - 1.5, y);
      on.moveTo(x + 1.5, y);
      on.lineTo(x + 5, y);
      on.moveTo(x - 1.5, y - 3.5);
      on.lineTo(x - 1.5, y + 3.5);
      on.moveTo(x + 1.5, y - 3.5);
      on.lineTo(x + 1.5, y + 3.5);
      on.stroke();
      break;
    case "run_began":
      on.rect(x - 1, y - 5, 2, 10);
      on.fill();
      break;
  }
}

/** What an event did, in a line. */
export function markText(history: History, mark: Mark): string {
  const place = (number: number) => isolated(label(history.placeIds[number] ?? "?", 40));
  const object = (number: number) => isolated(label(history.objectIds[number] ?? "?", 40));
  switch (mark.kind) {
    case "place_founded":
      return `${place(mark.ref)} founded`;
    case "place_merged": {
      const row = history.merges.absorbed.findIndex(
        (absorbed, index) => absorbed === mark.ref && history.merges.offset[index] === mark.offset,
      );
      return `${place(mark.ref)} absorbed${row < 0 ? "" : ` by ${place(history.merges.survivor[row])}`}`;
    }
    case "merge_refused": {
      const refused = history.refusals[mark.ref];
      return refused === undefined ? "merge refused" : `merge of ${place(refused.a)} and ${place(refused.b)} refused`;
    }
    case "objects_merged":
      return `${object(mark.ref)} became part of another object`;
    case "object_missing":
      return `${object(mark.ref)} is missing`;
    case "object_moved":
      return `${object(mark.ref)} stands elsewhere`;
    case "run_began":
      return `run ${isolated(label(history.runIds[mark.ref] ?? "?", 40))} began`;
    default:
      return isolated(label(history.system[mark.ref]?.text ?? KIND_NAMES[mark.kind], 90));
  }
}
