/** Completion of conditions: functions, words, and in quotes the names that the function takes. */

import type { History } from "../history/types";

export interface ConditionFunction {
  name: string;
  signature: string;
  parameters: string[];
  result: string;
  says: string;
}

export interface Completion {
  /** What replaces the text from `from` to the cursor. */
  insert: string;
  title: string;
  says: string;
  from: number;
}

const MOST = 10;
const WORDS: readonly string[] = ["and", "or", "not", "none"];

export function completions(text: string, cursor: number, functions: readonly ConditionFunction[], history: History): Completion[] {
  const before = text.slice(0, cursor);
  const quoted = openQuote(before);
  if (quoted !== null) return namesFor(before, quoted, functions, history);
  const word = /[A-Za-z_]*$/.exec(before)?.[0] ?? "";
  if (word === "" && before.trim() !== "" && !/[(\s]$/.test(before)) return [];
  const from = cursor - word.length;
  const begins = (name: string) => name.startsWith(word.toLowerCase()) && name !== word;
  return [
    ...functions
      .filter(({ name }) => begins(name))
      .map(({ name, signature, parameters, says }) => ({
        insert: parameters.length > 0 ? `${name}('` : `${name}()`,
        title: signature,
        says,
        from,
      })),
    ...(word === "" ? [] : WORDS.filter(begins).map((name) => ({ insert: `${name} `, title: name, says: "", from }))),
  ].slice(0, MOST);
}

/** A name as a text of a condition, without the quotes about it. */
const within = (name: string, sign: string) => name.replaceAll("\\", "\\\\").replaceAll(sign, `\\${sign}`);

export const quoted = (name: string) => `'${within(name, "'")}'`;

/** Where the quote begins that is open at the end of the text; null if none is. */
function openQuote(text: string): { at: number; sign: string } | null {
  let open: { at: number; sign: string } | null = null;
  for (let at = 0; at < text.length; at++) {
    if (open !== null && text[at] === "\\") at++;
    else if (open !== null && text[at] === open.sign) open = null;
    else if (open === null && (text[at] === "'" || text[at] === '"')) open = { at, sign: text[at] };
  }
  return open;
}

function namesFor(before: string, { at, sign }: { at: number; sign: string }, functions: readonly ConditionFunction[], history: History): Completion[] {
  const typed = before.slice(at + 1).replace(/\\(.)/gs, "$1");
  const call = /([A-Za-z_]+)\s*\(([^()]*)$/.exec(before.slice(0, at));
  const found = functions.find(({ name }) => name === call?.[1]);
  const number = (call?.[2].match(/,/g) ?? []).length;
  const kind = found?.parameters[number] ?? "place";
  const last = found === undefined || number + 1 >= found.parameters.length;
  const end = found === undefined ? sign : last ? `${sign})` : `${sign}, ${sign}`;
  return namesOf(kind, typed, history).map((name) => ({ insert: `${within(name, sign)}${end}`, title: name, says: kind, from: at + 1 }));
}

function namesOf(kind: string, typed: string, history: History): string[] {
  const wanted = typed.toLowerCase();
  const found: string[] = [];
  for (const name of everyName(kind, history)) {
    if (name.toLowerCase().includes(wanted)) found.push(name);
    if (found.length >= MOST) break;
  }
  return found;
}

function* everyName(kind: string, history: History): Iterable<string> {
  switch (kind) {
    case "place":
      yield* history.placeIds;
      break;
    case "object":
      yield* history.objectIds;
      break;
    case "class":
      yield* history.classes;
      break;
    case "run":
      yield* history.runIds;
      break;
    case "name":
      yield* new Set(history.names.flatMap(({ name }) => (name === null ? [] : [name])));
      break;
    case "keyframe": {
      const { run, id } = history.keyframes;
      for (let each = 0; each < run.length; each++) yield `${history.runIds[run[each]]}:${id[each]}`;
    }
  }
}
