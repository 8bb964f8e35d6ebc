/** What goes wrong in the page itself is told to the person, not only to the console. */

import { sentence } from "../state/loading";
import { tell } from "../state/pointer";

export function keepFaults() {
  const told = (error: unknown) => tell(`The page itself failed: ${sentence(error)}. Load it again; if it happens again, please report it.`);
  window.addEventListener("error", ({ error }) => error && told(error)); // without one it is a browser's remark
  window.addEventListener("unhandledrejection", ({ reason }) => reason?.name !== "AbortError" && told(reason));
}
