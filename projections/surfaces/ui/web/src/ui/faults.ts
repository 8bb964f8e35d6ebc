/** Shows errors of the page itself to the person, not only in the console. */

import { sentence } from "../state/loading";
import { showNotice } from "../state/pointer";

export function keepFaults() {
  const show = (error: unknown) => showNotice(`The page itself failed: ${sentence(error)}. Load it again; if it happens again, please report it.`);
  window.addEventListener("error", ({ error }) => error && show(error)); // without one it is a browser's remark
  window.addEventListener("unhandledrejection", ({ reason }) => reason?.name !== "AbortError" && show(reason));
}
