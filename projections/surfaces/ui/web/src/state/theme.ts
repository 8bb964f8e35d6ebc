/** Light or dark: the system's choice until the user chooses. */

import { effect } from "@preact/signals";
import { storage } from "./kept";
import * as store from "./store";

const KEY = "mapfold theme";

export function keepTheme() {
  const query = window.matchMedia("(prefers-color-scheme: dark)");
  store.systemDark.value = query.matches;
  query.addEventListener("change", () => {
    store.systemDark.value = query.matches;
  });
  const keeper = storage("localStorage");
  const kept = keeper?.getItem(KEY);
  if (kept === "light" || kept === "dark") store.theme.value = kept;
  effect(() => {
    document.documentElement.dataset["theme"] = store.dark.value ? "dark" : "light";
    if (store.theme.value === "auto") keeper?.removeItem(KEY);
    else keeper?.setItem(KEY, store.theme.value);
  });
}
