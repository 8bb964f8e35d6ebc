"""A database that is away: how long questions wait for it, and one line for people each way."""

import threading
import time
from collections.abc import Callable
from typing import Final

PATIENCE_S: Final = 10.0
"""Questions asked before that many seconds of an outage wait for its end, later ones do not."""


class Outage:
    """Begins with the first failure and ends with the first success; for many threads."""

    def __init__(self, tell: Callable[[str], None], now: Callable[[], float] = time.monotonic):
        self._tell, self._now, self._lock = tell, now, threading.Lock()
        self._until: float | None = None

    @property
    def is_on(self) -> bool:
        """Whether the last thing known is a failure."""
        return self._until is not None

    def begin(self, error: Exception) -> None:
        """Something failed."""
        with self._lock:
            if self._until is None:
                self._until = self._now() + PATIENCE_S
                self._tell(f"{error}; trying again")

    def end(self) -> None:
        """Something went well."""
        with self._lock:
            if self._until is not None:
                self._until = None
                self._tell("the database answers again")

    @property
    def worth_waiting(self) -> bool:
        """Whether it is young enough for a question to wait for its end."""
        until = self._until
        return until is not None and self._now() < until
