/** Colours of the canvas in light and dark. Those of places are Paul Tol's, told apart by the
 * colour-blind, a shade lighter on dark ground; places also carry their names. */

import type { History } from "../history/types";
import { placeColours } from "../model/colours";

export interface Palette {
  dark: boolean;
  ground: string;
  grid: string;
  ink: string;
  dim: string;
  faint: string;
  halo: string;
  wall: string;
  accent: string;
  added: string;
  removed: string;
  moved: string;
  noise: string;
  object: string;
  places: string[];
}

export const LIGHT: Palette = {
  dark: false,
  ground: "#fbfbfa",
  grid: "#eeeeec",
  ink: "#1c2024",
  dim: "#5b636d",
  faint: "#b9bfc6",
  halo: "#fbfbfa",
  wall: "#8a9099",
  accent: "#1f6fd6",
  added: "#0b7a4b",
  removed: "#b3261e",
  moved: "#8a4bbf",
  noise: "#8b929b",
  object: "#2b3138",
  places: ["#4477aa", "#cc6677", "#117733", "#b39b1e", "#aa4499", "#2a9bb0", "#882255", "#7a7a1f", "#6a5acd", "#c2692c"],
};

export const DARK: Palette = {
  dark: true,
  ground: "#15181c",
  grid: "#1f2328",
  ink: "#e8eaed",
  dim: "#a3abb5",
  faint: "#4b535d",
  halo: "#15181c",
  wall: "#79818c",
  accent: "#6cb0ff",
  added: "#4cc38a",
  removed: "#ff7b72",
  moved: "#c792ea",
  noise: "#7d8590",
  object: "#d6dae0",
  places: ["#7faedb", "#ee99aa", "#5bb97a", "#ddcc77", "#d98fcb", "#6fd0e0", "#c9769c", "#b9b95a", "#a99df2", "#eda36b"],
};

export function placeColour(palette: Palette, history: History, place: number): string {
  return place < 0 ? palette.noise : palette.places[placeColours(history, palette.places.length)[place]];
}

/** `#rrggbb` as the three bytes. */
export function rgb(colour: string): [number, number, number] {
  const value = Number.parseInt(colour.slice(1), 16);
  return [value >> 16, (value >> 8) & 255, value & 255];
}

export function withAlpha(colour: string, alpha: number): string {
  const [r, g, b] = rgb(colour);
  return `rgba(${r}, ${g}, ${b}, ${alpha})`;
}
