/** Asks the server that the page came from. Every failure becomes an `ApiError` with a sentence. */

import { storage } from "../state/kept";
import { isSaved, savedAnswer } from "./saved";

export class ApiError extends Error {
  constructor(
    readonly kind: string,
    message: string,
    /** For a condition: the column that is wrong, from 1. */
    readonly column: number | null = null,
  ) {
    super(message);
  }
}

export const LOST = "lost";

/** The token of the printed link, which may be needed for every question, and is for edits. */
const token = takeToken();
let onReach: (reached: boolean) => void = () => {};

/** Tells whether the server answered at all, after each question. */
export function watchServer(watcher: (reached: boolean) => void) {
  onReach = watcher;
}

/** From the printed link, which then no longer shows it; kept for a reload of this tab. */
function takeToken(): string | null {
  const shown = new URL(location.href);
  const hash = new URLSearchParams(shown.hash.replace(/^#/, ""));
  const found = hash.get("token") ?? shown.searchParams.get("token");
  if (found === null) return storage("sessionStorage")?.getItem("mapfold token") ?? null;
  storage("sessionStorage")?.setItem("mapfold token", found);
  hash.delete("token");
  shown.searchParams.delete("token");
  shown.hash = hash.toString();
  window.history.replaceState(null, "", shown);
  return found;
}

export const hasToken = token !== null;

function withToken(path: string): string {
  return path.startsWith("/") ? `.${path}` : path;
}

async function ask(path: string, init: RequestInit): Promise<Response> {
  const headers = new Headers(init.headers);
  if (token !== null) headers.set("Authorization", `Bearer ${token}`);
  let response: Response;
  try {
    response = await fetch(withToken(path), { ...init, headers, cache: "no-store" });
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    onReach(false);
    throw new ApiError(LOST, "The server does not answer. Is mapfold ui still running?");
  }
  onReach(true);
  if (!response.ok) throw await refused(response);
  return response;
}

async function refused(response: Response): Promise<ApiError> {
  try {
    const { error } = (await response.json()) as {
      error: { kind: string; message: string; column?: number };
    };
    return new ApiError(error.kind, error.message, error.column ?? null);
  } catch {
    return new ApiError("failed", `The server answered ${response.status} ${response.statusText}.`);
  }
}

let unanswered = 0;

function count(by: number) {
  document.documentElement.dataset.unanswered = String((unanswered += by));
}

/** Reads an answer. Questions whose answers the page has not taken in yet are counted as
 * `data-unanswered` of the document: at 0 what is shown is whole. */
async function answer<T>(as: "json" | "arrayBuffer", path: string, init: RequestInit): Promise<T> {
  count(1);
  try {
    if (isSaved) return (await ofPage(path)) as T;
    return (await (await ask(path, init))[as]()) as T;
  } finally {
    setTimeout(count, 0, -1); // whoever awaits the answer goes first
  }
}

async function ofPage(path: string): Promise<unknown> {
  const found = await savedAnswer(path);
  if (found === undefined) throw new ApiError("not_saved", "This page was saved without that answer; mapfold ui on the log has it.");
  return found;
}

export function getJson<T>(path: string, signal: AbortSignal | null = null): Promise<T> {
  return answer("json", path, { signal });
}

export function getBinary(path: string, signal: AbortSignal | null = null): Promise<ArrayBuffer> {
  return answer("arrayBuffer", path, { signal });
}

export function postJson<T>(path: string, body: unknown, signal: AbortSignal | null = null): Promise<T> {
  const headers = { "Content-Type": "application/json" };
  return answer("json", path, { method: "POST", headers, body: JSON.stringify(body), signal });
}

/** Server-sent events, one after the other until the server ends or is silent for long, which it
 * never is; with the token in a header. */
export async function* liveEvents(path: string, signal: AbortSignal): AsyncGenerator<unknown> {
  const response = await ask(path, { signal, headers: { Accept: "text/event-stream" } });
  if (response.body === null) return;
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const next = await Promise.race([reader.read(), silence()]);
    if (next === null) {
      await reader.cancel();
      return;
    }
    const { done, value } = next;
    if (done) return;
    const parts = (rest + value).replace(/\r\n/g, "\n").split("\n\n");
    rest = parts.pop() ?? "";
    for (const part of parts) {
      const data = part.split("\n").filter((line) => line.startsWith("data:"));
      if (data.length > 0) yield JSON.parse(data.map((line) => line.slice(5).trimStart()).join("\n"));
    }
  }
}

const LONGEST_SILENCE_MS = 40_000;

function silence(): Promise<null> {
  return new Promise((resolve) => setTimeout(() => resolve(null), LONGEST_SILENCE_MS));
}

/** `/api/why?what=place%3Ap1&at=3`, without parameters that are null or undefined. */
export function address(path: string, parameters: Record<string, string | number | null | undefined>) {
  const search = new URLSearchParams();
  for (const [name, value] of Object.entries(parameters)) {
    if (value !== null && value !== undefined && value !== "") search.set(name, String(value));
  }
  const text = search.toString();
  return text === "" ? path : `${path}?${text}`;
}
