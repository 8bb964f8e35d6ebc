/** What is under the pointer, in a few lines. */

import { placeNow } from "../model/compare";
import { counted, isolated, keyframeTitle, label, placeTitle } from "../model/names";
import { markTip, tip } from "../state/pointer";
import * as store from "../state/store";
import { when } from "./summary";

export function Tooltip() {
  const found = tip.value;
  const lines = found !== null ? thingLines(found) : markTip.value?.lines;
  const at = found ?? markTip.value;
  if (lines === undefined || lines.length === 0 || at === null) return null;
  const right = at.x > window.innerWidth - 320;
  const low = at.y > window.innerHeight - 160;
  const style = {
    left: `${at.x + (right ? -14 : 14)}px`,
    top: `${at.y + (low ? -14 : 14)}px`,
    transform: `translate(${right ? "-100%" : "0"}, ${low ? "-100%" : "0"})`,
  };
  return (
    <div class="tip" role="tooltip" style={style}>
      {lines.map((line, index) => (
        <div key={index} class={index === 0 ? "first" : ""}>
          {line}
        </div>
      ))}
    </div>
  );
}

function thingLines({ thing, number, side }: NonNullable<typeof tip.value>): string[] {
  const { history, map } = side === "main" ? { history: store.history.value, map: store.map.value } : store.other.value;
  if (history === null || map === null) return [];
  const place = (each: number) => (each < 0 ? "in no place" : `in ${isolated(label(placeTitle(history, map, each), 40))}`);
  switch (thing.kind) {
    case "place": {
      if (map.standsAs[number] !== number) return [];
      return [
        isolated(label(placeTitle(history, map, number), 48)),
        isolated(label(history.placeIds[number], 48)),
        counted(map.size[number], "keyframe"),
      ];
    }
    case "object": {
      const row = map.objectRow[number];
      if (row < 0) return [];
      const { count, missing, x, y } = history.changes;
      return [
        isolated(label(history.classes[history.changes.class[row]] ?? "", 48)),
        isolated(label(history.objectIds[number], 48)),
        `seen ${counted(count[row], "time")}, ${place(placeNow(history, map, row))}${missing[row] ? ", missing" : ""}`,
        `at (${x[row].toFixed(2)}, ${y[row].toFixed(2)}) m`,
      ];
    }
    case "keyframe": {
      if (number >= map.keyframeCount) return [];
      const { x, y, yaw, offset, stamp } = history.keyframes;
      return [
        isolated(label(keyframeTitle(thing.id), 48)),
        place(map.placeOf[number]),
        `at (${x[number].toFixed(2)}, ${y[number].toFixed(2)}) m, facing ${Math.round((yaw[number] * 180) / Math.PI)}°`,
        `event ${offset[number]}  ${when(stamp[number])}`,
      ];
    }
    default:
      return [];
  }
}
