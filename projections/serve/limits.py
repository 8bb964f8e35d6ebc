"""How much a service takes on: questions a second, and questions that wait."""

import threading
import time
from collections.abc import Callable

from eventsrc.errors import MapfoldError


class TooMuchError(MapfoldError):
    """The service has more questions than it may answer; ask again later."""


class BusyError(TooMuchError):
    """Too many questions wait already, or this one has waited for too long."""


class Bucket:
    """At most ``per_second`` questions a second in the long run, twice as many at once."""

    def __init__(self, per_second: float, now: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._size = per_second, max(1.0, 2.0 * per_second)
        self._now, self._lock = now, threading.Lock()
        self._tokens, self._filled = self._size, now()

    def take(self) -> None:
        """Take one token. Raises TooMuchError when there is none."""
        with self._lock:
            now = self._now()
            self._tokens = min(self._size, self._tokens + (now - self._filled) * self._rate)
            self._filled = now
            if self._tokens < 1.0:
                raise TooMuchError(
                    f"more than {self._rate:g} questions a second; ask again in a second"
                )
            self._tokens -= 1.0
