/** The page: bar, map, panel, timeline. */

import { MapCanvas, changeView, fitView } from "../map/MapCanvas";
import { SidePanel } from "../panels/SidePanel";
import { notice } from "../state/pointer";
import { progress } from "../state/loading";
import * as store from "../state/store";
import { Timeline } from "../timeline/Timeline";
import { ContextMenu } from "./ContextMenu";
import { Digest } from "./Digest";
import { Help } from "./Help";
import { Icon } from "./icons";
import { Legend, ScaleBar } from "./Legend";
import { Tooltip } from "./Tooltip";
import { TopBar } from "./TopBar";
import { counted } from "../model/names";

export function App() {
  const two = store.twoMaps.value;
  return (
    <div class="app" data-panel={store.panel.value === null ? "closed" : "open"}>
      <TopBar />
      <Banner />
      <main class={two ? "stage two" : "stage"}>
        <div class="pane">
          <MapCanvas side="main" />
          {two && <p class="pane-title">{paneTitle("main")}</p>}
        </div>
        {two && (
          <div class={store.compareMode.value === "moments" ? "pane before" : "pane"}>
            <MapCanvas side="other" />
            <p class="pane-title">{paneTitle("other")}</p>
          </div>
        )}
        <NoMap />
        <Digest />
        <ScaleBar />
        <div class="zoom" role="group" aria-label="Zoom">
          <button class="icon" type="button" aria-label="Zoom in" title="Zoom in (+)" onClick={() => changeView(1.25)}>
            <Icon name="plus" />
          </button>
          <button class="icon" type="button" aria-label="Zoom out" title="Zoom out (−)" onClick={() => changeView(0.8)}>
            <Icon name="minus" />
          </button>
          <button class="icon" type="button" aria-label="Show the whole map" title="Show the whole map (F)" onClick={fitView}>
            <Icon name="fit" />
          </button>
        </div>
      </main>
      <Legend />
      <SidePanel />
      <Timeline />
      <Tooltip />
      <ContextMenu />
      <Help />
      <div class="notice" role="status" aria-live="polite">
        {notice.value}
      </div>
    </div>
  );
}

function paneTitle(side: "main" | "other"): string {
  const { history, map } = side === "main" ? { history: store.history.value, map: store.map.value } : store.other.value;
  if (history === null || map === null) return "";
  if (store.compareMode.value === "moments") return `${side === "main" ? "after" : "before"}: ${counted(map.at, "event")}, ${counted(map.places.length, "place")}`;
  const { eps_m, min_samples } = history.settings;
  const settings = side === "main" ? store.log.value?.places_text : `ε ${eps_m} m, min_samples ${min_samples}`;
  return `${side === "main" ? "as recorded" : "what if"}: ${counted(map.places.length, "place")}, ${settings}`;
}

/** What is wrong with the log or the server, in sentences. */
function Banner() {
  const problems = store.history.value?.through ? (store.log.value?.problems ?? []) : []; // else in the middle
  const lost = store.serverLost.value && store.history.value !== null;
  const refused = lost ? null : store.refused.value;
  if (problems.length === 0 && !lost && refused === null) return null;
  return (
    <div class="banner" role="alert">
      {lost && <p>The server does not answer. The map stays as it was. Is mapfold ui still running?</p>}
      {refused !== null && <p>{refused}</p>}
      {problems.map((problem) => (
        <p key={problem}>{problem}</p>
      ))}
    </div>
  );
}

function NoMap() {
  const history = store.history.value;
  const failure = store.failure.value;
  if (failure !== null) return <div class="no-map" role="alert"><p>{failure}</p></div>;
  if (history === null) {
    const folded = progress.value;
    return (
      <div class="no-map" role="status">
        <p>{folded === null ? "Reading the log …" : `Folding the log: ${folded.folded.toLocaleString("en")} of ${counted(folded.events, "event")}`}</p>
        {folded !== null && folded.events > 0 && <progress value={folded.folded} max={folded.events} aria-label="Events folded" />}
      </div>
    );
  }
  if (history.through === 0) return <div class="no-map"><p>{store.log.value?.problems.join(" ") || "This log has no events yet."}</p></div>;
  if (store.bounds.value === null) return <div class="no-map"><p>No keyframe of this log has a pose, so there is nothing to draw. The timeline, Find and the objects’ stories still work.</p></div>;
  return null;
}
