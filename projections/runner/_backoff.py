"""Pauses between attempts to reach a database that is away."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

from projections.errors import DatabaseError, DatabaseUnavailable, EmbeddedServerError

AWAY: Final = (DatabaseUnavailable, EmbeddedServerError)
"""What another attempt may mend: a server killed once more while it starts does not start."""
FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0

OnTrouble: TypeAlias = Callable[[str], None]


@dataclass(slots=True)
class Backoff:
    """One outage. Gives up after ``patience_s`` without a connection; None never does."""

    place: str
    stop: threading.Event
    trouble: OnTrouble
    patience_s: float | None = None
    pause_s: float = FIRST_PAUSE_S
    waited_s: float = 0.0

    def wait(self) -> None:
        """Wait before the next attempt. Raises DatabaseUnavailable when stopped meanwhile."""
        if self.stop.wait(self.pause_s):
            raise DatabaseUnavailable(
                f"{self.place}: stopped while the database was away; what was not written yet is in"
                " the log and comes with the next start"
            )

    def failed(self, error: DatabaseError) -> None:
        """An attempt failed: tell of it and wait longer next time. Raises it out of patience."""
        self.waited_s += self.pause_s
        if self.patience_s is not None and self.waited_s > self.patience_s:
            raise error
        self.trouble(str(error))
        self.pause_s = min(self.pause_s * 2, LONGEST_PAUSE_S)
