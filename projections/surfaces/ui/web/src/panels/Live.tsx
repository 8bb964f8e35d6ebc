/** Follows a log that grows: server-sent events say when there is more. A page that is hidden does
 * not listen: browsers open at most six connections to a server, and each page would hold one. */

import { signal } from "@preact/signals";
import { ApiError, LOST, liveEvents } from "../api/client";
import { counted } from "../model/names";
import { goLive } from "../state/actions";
import { grow } from "../state/loading";
import * as store from "../state/store";

interface Sink {
  name?: string;
  sink?: string;
  lag?: number | null;
  lag_events?: number | null;
}

interface LiveNews {
  through: number;
  state: string;
  events: number;
  /** Whether the last segment is open for more. */
  growing: boolean;
  lag: number;
  losses?: number | { count: number } | null;
  rejected?: number | null;
  problems?: string[];
  sinks?: Sink[] | null;
  database_problem?: string | null;
}

const news = signal<LiveNews | null>(null);
/** Whether events came while the page was open. */
const grew = signal(false);
const AGAIN_MS = 1500;

export function keepLive() {
  let stop = new AbortController();
  const listen = async () => {
    for (;;) {
      await shown();
      stop = new AbortController();
      try {
        for await (const heard of liveEvents("/api/live", stop.signal)) hear(heard as LiveNews);
      } catch (error) {
        // The banner reports that the server does not answer.
        const refused = error instanceof ApiError && error.kind !== LOST;
        if (refused) store.refused.value = `The page does not follow the log: ${error.message}`;
      }
      await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    }
  };
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) stop.abort();
  });
  void listen();
}

/** Waits until the page is not hidden. */
function shown(): Promise<void> {
  return new Promise((resolve) => {
    const look = () => {
      if (document.hidden) return;
      document.removeEventListener("visibilitychange", look);
      resolve();
    };
    document.addEventListener("visibilitychange", look);
    look();
  });
}

function hear(heard: LiveNews) {
  store.refused.value = null;
  const before = store.history.value;
  const problems = JSON.stringify(heard.problems ?? []);
  const known = JSON.stringify(store.log.value?.problems ?? []);
  grew.value ||= news.value !== null && heard.through > news.value.through;
  news.value = heard;
  if (before === null || heard.through !== before.through || heard.state !== before.state || problems !== known) void grow();
}

export function LiveState() {
  const heard = news.value;
  const on = store.live.value;
  const lost = typeof heard?.losses === "number" ? heard.losses : (heard?.losses?.count ?? 0);
  const parts = [
    ...(lost > 0 ? [`${lost.toLocaleString("en")} lost`] : []),
    ...((heard?.rejected ?? 0) > 0 ? [`${(heard?.rejected ?? 0).toLocaleString("en")} rejected`] : []),
    ...((heard?.lag ?? 0) > 0 ? [`${counted(heard?.lag ?? 0, "event")} not folded yet`] : []),
    ...(heard?.sinks ?? []).map((sink) => `${sink.name ?? sink.sink ?? "database"}: ${sink.lag ?? sink.lag_events ?? 0} behind`),
    ...(heard?.database_problem ? ["database does not answer"] : []),
  ];
  return (
    <div class="live">
      {parts.length > 0 && (
        <span class="lag" title={heard?.database_problem ?? parts.join(", ")}>
          {parts.join(", ")}
        </span>
      )}
      {((heard?.growing ?? false) || grew.value) && (
        <button type="button" class={on ? "button live-on" : "button quiet"} aria-pressed={on} title={on ? "The page follows the log; a click keeps this moment (L)" : "Follow the end of the log (L)"} onClick={() => goLive(!on)}>
          <i class="lamp" aria-hidden="true" />
          Live
        </button>
      )}
    </div>
  );
}
