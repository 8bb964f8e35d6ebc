"""A tail's progress, for other threads to read and to wait for."""

import threading
import time
from dataclasses import dataclass, field

from eventsrc.envelope.model import FIRST_OFFSET, Offset

from .checkpoints import DeadLetter


@dataclass(slots=True)
class TailReport:
    """A tail's counts so far: batches and events written, its offset, parked events, and
    refolds."""

    next_offset: Offset = FIRST_OFFSET
    events: int = 0
    batches: int = 0
    restarts: int = 0
    parked: list[DeadLetter] = field(default_factory=list)
    refolds: int = 0


class TailProgress:
    """Give one to `tail`; any thread may then read ``next_offset`` or `wait` for it."""

    def __init__(self) -> None:
        self._moved = threading.Condition()
        self.next_offset = 0
        self.events = 0
        self.batches = 0
        self.restarts = 0
        self.parked = 0
        self.failures = 0
        self.committed_at: float | None = None

    def update(self, report: TailReport) -> None:
        """Set the progress, at the tail's start and after each commit, and wake waiting threads."""
        with self._moved:
            if report.batches > self.batches:
                self.committed_at = time.monotonic()
            self.next_offset = report.next_offset
            self.events, self.batches = report.events, report.batches
            self.restarts, self.parked = report.restarts, len(report.parked)
            self._moved.notify_all()

    def count_failure(self) -> None:
        """Count a failed attempt."""
        with self._moved:
            self.failures += 1

    def wait(self, next_offset: Offset, timeout_s: float) -> bool:
        """True once ``next_offset`` events are committed; False after ``timeout_s`` seconds."""
        with self._moved:
            return self._moved.wait_for(lambda: self.next_offset >= next_offset, timeout_s)
