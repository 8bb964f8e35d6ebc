/** An answer of the server to a question that changes: the newest question counts. */

import { useEffect, useState } from "preact/hooks";
import { ApiError, getJson } from "../api/client";

export interface Asked<T> {
  value: T | null;
  error: ApiError | null;
  loading: boolean;
}

/** Asks when `path` changes; null asks nothing. The old answer stays until the new one is there. */
export function useAnswer<T>(path: string | null, again: unknown = null): Asked<T> {
  const [asked, setAsked] = useState<Asked<T>>({ value: null, error: null, loading: path !== null });
  useEffect(() => {
    if (path === null) {
      setAsked({ value: null, error: null, loading: false });
      return undefined;
    }
    const abort = new AbortController();
    setAsked((before) => ({ ...before, loading: true }));
    getJson<T>(path, abort.signal).then(
      (value) => setAsked({ value, error: null, loading: false }),
      (error: unknown) => {
        if (error instanceof DOMException && error.name === "AbortError") return;
        const failure = error instanceof ApiError ? error : new ApiError("failed", String(error));
        setAsked({ value: null, error: failure, loading: false });
      },
    );
    return () => abort.abort();
  }, [path, again]);
  return asked;
}
