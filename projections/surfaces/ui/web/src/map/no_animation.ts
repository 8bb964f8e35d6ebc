/**
 * Stands in for d3-transition and d3-interpolate, of which d3-zoom names one function each, for
 * animations: this page has none, and what is left out is a tenth of its script.
 */

export function interrupt() {}

export function interpolateZoom(): never {
  throw new Error("the map is not animated");
}
