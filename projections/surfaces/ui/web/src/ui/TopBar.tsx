/** The line above the map: which log, search, live, what to take away, help. */

import { isSaved } from "../api/saved";
import { goLive } from "../state/actions";
import { LiveState } from "../panels/Live";
import { TakeAway } from "../panels/TakeAway";
import * as store from "../state/store";
import { counted, isolated, label } from "../model/names";
import { helpOpen } from "./Help";
import { Icon } from "./icons";
import { Search } from "./Search";

export function TopBar() {
  const log = store.log.value;
  const dark = store.dark.value;
  return (
    <header class="bar">
      <h1>
        <svg viewBox="0 0 16 16" width="18" height="18" aria-hidden="true" class="logo">
          <path d="M5 5.5 11 10.5" />
          <circle cx="4.8" cy="5.3" r="3" />
          <circle cx="11.2" cy="10.7" r="3" />
        </svg>
        <bdi title={log?.path ?? log?.name ?? ""}>{log === null ? "mapfold" : label(log.name, 36)}</bdi>
      </h1>
      <SettingsNote />
      <Search />
      <span class="space" />
      {isSaved ? <span class="dim saved" title="It has the map at all moments and asks no server">saved page</span> : <LiveState />}
      <TakeAway />
      <button class="icon" type="button" aria-label={dark ? "Light colours" : "Dark colours"} title={dark ? "Light colours (T)" : "Dark colours (T)"} onClick={toggleTheme}>
        <Icon name={dark ? "sun" : "moon"} />
      </button>
      <button class="icon" type="button" aria-label="Help" title="Help (?)" onClick={() => (helpOpen.value = true)}>
        <Icon name="help" />
      </button>
    </header>
  );
}

export function toggleTheme() {
  store.theme.value = store.dark.value ? "light" : "dark";
}

/** The settings of the log, in short: those that matter for places, and how many others differ. */
function SettingsNote() {
  const log = store.log.value;
  if (log === null) return null;
  const runs = log.runs.map((run) => run.run_id);
  const title = Object.entries(log.changed_settings ?? {})
    .map(([name, value]) => `${name}=${String(value)}`)
    .join("\n");
  return (
    <p class="settings" title={title === "" ? "default settings" : title}>
      <span>{log.places_text}</span>
      {log.fusion !== "page" && <span>fusion: {log.fusion}</span>}
      <span class="runs">{runs.length === 1 ? <bdi>{isolated(label(runs[0], 24))}</bdi> : counted(runs.length, "run")}</span>
    </p>
  );
}

export function followLive() {
  goLive(!store.live.value);
}
