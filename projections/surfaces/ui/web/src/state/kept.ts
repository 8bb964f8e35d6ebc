/** What the browser keeps for the page; null where it is set to keep nothing. */

export function storage(area: "localStorage" | "sessionStorage"): Storage | null {
  try {
    return window[area];
  } catch {
    return null; // the page works without: it only forgets the token and the colours at a reload
  }
}
