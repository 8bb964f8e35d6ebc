/** The way of a robot to what is selected, and for an object the pose from which to see it. */

import { useEffect } from "preact/hooks";
import { address } from "../api/client";
import type { History } from "../history/types";
import { findPlace, label, shortPlace } from "../model/names";
import { useAnswer } from "../state/answers";
import { way } from "../state/overlays";
import * as store from "../state/store";
import { Answer, CommandLine, ThingLink, copy } from "./AnswerParts";

interface Named {
  place_id: string;
  name: string | null;
  type: string | null;
}

interface WayAnswer {
  path: { length_m: number; places: Named[]; doors: { x: number; y: number }[]; way_points: [number, number][] } | null;
  goal: { x: number; y: number; yaw: number; distance_m: number; walls_known: boolean } | null;
  yaml: string | null;
  command: string;
}

const ROBOT = "robot";
const GOAL = "goal";

/** The last pose before W, as a point of the map frame. */
function robotAt({ keyframes, origin }: History, count: number): string | null {
  let last = count - 1;
  while (last >= 0 && Number.isNaN(keyframes.x[last])) last--;
  return last < 0 ? null : `${(keyframes.x[last] + origin[0]).toFixed(3)},${(keyframes.y[last] + origin[1]).toFixed(3)}`;
}

export function Way({ thing, history, at }: { thing: store.Thing; history: History; at: number }) {
  const from = store.wayFrom.value;
  const robot = robotAt(history, store.restedMap.value?.keyframeCount ?? 0);
  const isObject = thing.kind === "object";
  const start = from === ROBOT ? robot : from;
  const ready = from === GOAL ? isObject : start !== null && start !== thing.id;
  const path = address("/api/path", { from: from === GOAL ? null : start, to: thing.id, at, known_at: store.knownAt(at) });
  const asked = useAnswer<WayAnswer>(ready ? path : null, history.state);
  const found = ready ? asked.value : null;
  useEffect(() => {
    const [dx, dy] = history.origin;
    const moved = ([x, y]: readonly [number, number]): [number, number] => [x - dx, y - dy];
    way.value = found === null ? null : {
      points: (found.path?.way_points ?? []).map(moved),
      doors: (found.path?.doors ?? []).map(({ x, y }) => moved([x, y])),
      goal: found.goal === null ? null : { x: found.goal.x - dx, y: found.goal.y - dy, yaw: found.goal.yaw },
    };
    return () => {
      way.value = null;
    };
  }, [found]);
  const rooms = store.mapFacts.value?.rooms ?? [];
  const called = ({ place_id, name, type }: Named) => [name ?? type, shortPlace(history, findPlace(history, place_id))].filter(Boolean).map((each) => label(String(each), 20)).join(" ");
  const listed = rooms.some(({ place_id }) => place_id === from) || from === null || from === ROBOT || from === GOAL;
  return (
    <section class="way" aria-label="Way">
      <label>
        Way here from
        <select value={from ?? ""} onChange={({ currentTarget: { value } }) => (store.wayFrom.value = value === "" ? null : value)}>
          <option value="">choose …</option>
          {robot !== null && <option value={ROBOT}>the robot</option>}
          {isObject && <option value={GOAL}>nowhere: only where to see it from</option>}
          {!listed && <option value={from as string}>{label(from as string, 30)}</option>}
          {rooms.filter(({ place_id }) => place_id !== thing.id).map((each) => <option key={each.place_id} value={each.place_id}>{called(each)}</option>)}
        </select>
      </label>
      {ready && (
        <Answer asked={asked}>
          {({ path: found, goal, yaml, command }) => (
            <>
              {found !== null && (
                <p>
                  {found.length_m.toFixed(1)} m: {found.places.map((each, number) => <>{number > 0 && " → "}<ThingLink thing={{ kind: "place", id: each.place_id }}>{called(each)}</ThingLink></>)}
                </p>
              )}
              {goal !== null && (
                <p>
                  Seen from ({goal.x.toFixed(2)}, {goal.y.toFixed(2)}) facing {Math.round((goal.yaw * 180) / Math.PI)}°, {goal.distance_m.toFixed(2)} m away{!goal.walls_known && "; no walls are known there"}.
                </p>
              )}
              {yaml !== null && <button type="button" class="button" onClick={() => void copy(yaml, "the goal as YAML")}>Copy the goal as YAML</button>}
              <CommandLine command={command} />
            </>
          )}
        </Answer>
      )}
    </section>
  );
}
