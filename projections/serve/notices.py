"""Lines for people about what may happen often: the first at once, its like once a minute."""

import threading
import time
from collections.abc import Callable
from typing import Final

EVERY_S: Final = 60.0
_MOST: Final = 100


class Notices:
    """Passes lines on to ``tell``, from any thread; counts those that it holds back."""

    def __init__(
        self, tell: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._tell, self._now, self._lock = tell, now, threading.Lock()
        self._told: dict[str, tuple[float, int]] = {}  # when last told, and how often since

    def __call__(self, line: str) -> None:
        """Tell the line, unless it was told within the last minute."""
        with self._lock:
            now = self._now()
            at, count = self._told.get(line, (-EVERY_S, 0))
            if now - at < EVERY_S:
                self._told[line] = (at, count + 1)
                return
            if len(self._told) >= _MOST:
                self._told.clear()
            self._told[line] = (now, 0)
        self._tell(f"{line} (and {count} more like it since)" if count else line)
