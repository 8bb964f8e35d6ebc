/** A page that was saved has the server's answers in it and asks no server. Its moments are fewer than
 * the log's events: an answer is that of the last one before. projections/surfaces/ui/saved_page.py
 * writes them. */

type Slot = string | number | boolean | null | [number];

interface Saved {
  answers: Record<string, [number, number][]>;
  values: (Record<string, Slot> | Slot[])[];
}

export const isSaved = document.getElementById("saved-answers") !== null;

async function unpacked(id: string): Promise<ArrayBuffer> {
  const text = atob(document.getElementById(id)?.textContent ?? "");
  const bytes = Uint8Array.from(text, (char) => char.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

let saved: Saved = { answers: {}, values: [] };
let isRead = false;
const made = new Map<number, unknown>();

/** A value from its parts; those that several answers have in common are one object. */
function value(slot: Slot): unknown {
  if (!Array.isArray(slot)) return slot;
  const [number] = slot;
  if (!made.has(number)) {
    const found = saved.values[number];
    const parts = Array.isArray(found) ? found.map(value) : Object.fromEntries(Object.entries(found).map(([name, each]) => [name, value(each)]));
    made.set(number, parts);
  }
  return made.get(number);
}

/** The row of a question that is of the moment, or of the last one before that was saved. */
function rowAt(name: string, at: number): [number, number] | undefined {
  return saved.answers[name]?.findLast(([moment]) => moment <= at);
}

/** The moment whose tables are shown at another one. */
export function savedMoment(at: number): number | null {
  return rowAt("overview", at)?.[0] ?? null;
}

/** The answer to a question in the page's own words; undefined where the page was saved without. */
export async function savedAnswer(path: string): Promise<unknown> {
  const { pathname, searchParams } = new URL(path, "http://saved");
  const question = pathname.replace(/^\/api\//, "");
  if (question === "history") return unpacked("saved-history");
  if (!isRead) saved = JSON.parse(new TextDecoder().decode(await unpacked("saved-answers"))) as Saved;
  isRead = true;
  const named = [...searchParams].filter(([name]) => !["at", "known_at", "top"].includes(name));
  const name = [question, ...named.map(([key, each]) => `${key}=${each}`).sort()].join("\n");
  const at = MOVING.includes(question) ? Number(searchParams.get("at")) : Infinity;
  const row = rowAt(name, at);
  return row === undefined ? undefined : value([row[1]]);
}

/** The questions that are answered anew at each moment; the others are as of the end. */
const MOVING = ["overview", "digest", "find"];
