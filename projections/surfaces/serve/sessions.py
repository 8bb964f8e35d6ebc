"""Sessions of robots whose questions are tracked, by the names they give.

At most ``MOST`` are kept. One without a question for ``SILENT_S`` is removed, and when there are
more, the one that asked longest ago. If it asks again, a new session begins, and the answer has
``questions`` 1. A question that cannot be answered does not count: the robot's next movement is
since the last answered one.
"""

import threading
import time
from collections.abc import Callable
from typing import Any, Final

from projections.fold.map_errors import QuestionError
from projections.localize.relocalize import Answer, describe_value
from projections.localize.relocalize.question import Movement
from projections.localize.relocalize.track import Track

MOST: Final = 256
SILENT_S: Final = 600.0
MAX_NAME: Final = 128


class Sessions:
    """The sessions; for many threads. Questions of one session are applied in the order of their
    answers."""

    def __init__(self, now: Callable[[], float] = time.monotonic, most: int = MOST) -> None:
        self._now, self._most, self._lock = now, most, threading.Lock()
        self._kept: dict[str, tuple[float, Track]] = {}  # the longest silent first

    def __len__(self) -> int:
        with self._lock:
            self._forget()
            return len(self._kept)

    def tracked(self, name: str, moved: Movement, answer: Answer) -> dict[str, Any]:
        """The session's estimate of the robot's pose, as JSON."""
        with self._lock:  # a step takes a few milliseconds of numpy, so one lock is enough
            self._forget()
            _, track = self._kept.pop(name, (0.0, None))
            if track is None:
                track = Track(name)
            found = track.step(moved, answer.hypotheses, answer.confidence, answer.known)
            self._kept[name] = (self._now(), track)  # not before: a step that failed is discarded
            if len(self._kept) > self._most:
                del self._kept[next(iter(self._kept))]
            return found.document()

    def _forget(self) -> None:
        ended = self._now() - SILENT_S
        while self._kept:
            name, (at, _) = next(iter(self._kept.items()))
            if at > ended:
                return
            del self._kept[name]


def session_name(value: Any) -> str | None:
    """The name of a session, None for none. Raises QuestionError."""
    if value is None:
        return None
    if not isinstance(value, str) or not 1 <= len(value) <= MAX_NAME:
        raise QuestionError(
            f"session is {describe_value(value)}; give a name of 1 to {MAX_NAME} characters"
        )
    return value
