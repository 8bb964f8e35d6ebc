"""A tail's progress, for others to read and to wait for."""

import threading
import time
from dataclasses import dataclass, field

from projections.sinks._checkpoint import DeadLetter


@dataclass(slots=True)
class TailReport:
    """What a tail did so far: batches and events written, where it stands, what it parked."""

    next_offset: int = 0
    events: int = 0
    batches: int = 0
    restarts: int = 0
    parked: list[DeadLetter] = field(default_factory=list)


class TailProgress:
    """Give one to `tail`; any thread may then read ``next_offset`` or `wait` for it."""

    def __init__(self) -> None:
        self._moved = threading.Condition()
        self.next_offset = 0
        self.events = 0
        self.batches = 0
        self.restarts = 0
        self.parked = 0
        self.troubles = 0
        self.committed_at: float | None = None

    def update(self, report: TailReport) -> None:
        """Take in where the tail is, at its start and after each commit; wakes who waits."""
        with self._moved:
            if report.batches > self.batches:
                self.committed_at = time.monotonic()
            self.next_offset = report.next_offset
            self.events, self.batches = report.events, report.batches
            self.restarts, self.parked = report.restarts, len(report.parked)
            self._moved.notify_all()

    def trouble(self, _what: str) -> None:
        """Count a failed attempt."""
        with self._moved:
            self.troubles += 1

    def wait(self, next_offset: int, timeout_s: float) -> bool:
        """True once ``next_offset`` events are committed; False when that takes too long."""
        with self._moved:
            return self._moved.wait_for(lambda: self.next_offset >= next_offset, timeout_s)
