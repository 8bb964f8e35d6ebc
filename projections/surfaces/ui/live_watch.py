"""Server-sent events for a growing log, one whenever something changed.

A thread polls for new events; each page has a stream, which ends with the service. The lag of the
databases' tails is queried only if a database is named.
"""

import asyncio
import contextlib
import json
import threading
from collections.abc import AsyncIterator, Callable
from typing import Any, Final, Self

from eventsrc.base.errors import MapfoldError
from eventsrc.log.format import list_growing

from .question_threads import UiService

LOOK_S: Final = 0.3
TAILS_S: Final = 5.0
MOST_STREAMS: Final = 32
"""The most streams; each holds a connection, and the server has 128."""
_SEND_S: Final = 0.1
_BEAT_S: Final = 15.0

Tails = Callable[[], list[dict[str, Any]]]
"""The state of the databases' sinks. Raises DatabaseError."""


class LiveWatch:
    """Polls the log for new events until closed; use it in a ``with`` block. ``close`` ends all
    streams."""

    def __init__(self, service: UiService, tails: Tails | None = None) -> None:
        self._service, self._tails = service, tails
        self._sinks: list[dict[str, Any]] | None = None
        self._fault: str | None = None
        self._closing = threading.Event()
        self._streams, self._growing = 0, False
        self._threads = [threading.Thread(target=self._look, name="look")]
        if tails is not None:
            self._threads.append(threading.Thread(target=self._ask_tails, name="tails"))
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all streams, and stop looking. May be called twice."""
        self._closing.set()
        for thread in self._threads:
            thread.join()

    @property
    def is_full(self) -> bool:
        """Whether `MOST_STREAMS` streams are open."""
        return self._streams >= MOST_STREAMS

    def document(self) -> dict[str, Any]:
        """The event that is sent now."""
        log = self._service.log_document()
        heard = ("through", "state", "events", "problems", "losses", "rejected", "loading")
        found = {name: log[name] for name in heard}
        found["lag"] = max(log["events"], log["loading"]["events"]) - log["through"]
        found["growing"] = self._growing
        if self._tails is not None:
            found["sinks"], found["database_problem"] = self._sinks, self._fault
        return found

    async def stream(self) -> AsyncIterator[bytes]:
        """Server-sent events: one at once, then one for each change."""
        last, silent = "", 0.0
        self._streams += 1
        try:
            yield b"retry: 1000\n\n"
            while not self._closing.is_set():
                now = json.dumps(self.document(), allow_nan=False)
                if now != last:
                    last, silent = now, 0.0
                    yield f"event: log\ndata: {now}\n\n".encode()
                elif silent >= _BEAT_S:
                    silent = 0.0
                    yield b": still here\n\n"
                await asyncio.sleep(_SEND_S)
                silent += _SEND_S
        finally:
            self._streams -= 1

    def _look(self) -> None:
        while not self._closing.wait(LOOK_S):
            with contextlib.suppress(OSError):  # a log that is gone is among the problems
                last = list_growing(self._service.opened.log)[-1:]
                self._growing = any(not segment.sealed for segment in last)
            looked = self._service.refresh()
            while not self._closing.is_set():
                try:
                    error = looked.exception(LOOK_S)
                except TimeoutError:
                    continue
                if error is not None and not isinstance(error, MapfoldError):
                    raise error  # to stderr; that the page follows no more is among the problems
                break

    def _ask_tails(self) -> None:
        while self._tails is not None and not self._closing.is_set():
            try:
                self._sinks, self._fault = self._tails(), None
            except MapfoldError as error:
                self._fault = str(error)
            self._closing.wait(TAILS_S)
