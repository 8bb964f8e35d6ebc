"""How far the fold of a log is, written by the thread that folds and read by all others."""

from typing import Any


class Loading:
    """Events folded and events in all."""

    def __init__(self) -> None:
        self._folded, self._events, self._done = 0, 0, False

    def show(self, folded: int, events: int) -> None:
        """Called while events are folded."""
        self._folded, self._events = folded, events

    def finish(self) -> None:
        """The log is folded once."""
        self._done = True

    @property
    def is_done(self) -> bool:
        return self._done

    def document(self) -> dict[str, Any]:
        """JSON."""
        return {"done": self._done, "folded": self._folded, "events": self._events}
