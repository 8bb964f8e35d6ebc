"""A tail's progress, for others to read and to wait for.

A tail's numbers for Prometheus.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from eventsrc.metrics import MetricValue, serving_values

from .checkpoints import DeadLetter


@dataclass(slots=True)
class TailReport:
    """What a tail did so far: batches and events written, where it stands, what it parked."""

    next_offset: Offset = FIRST_OFFSET
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

    def wait(self, next_offset: Offset, timeout_s: float) -> bool:
        """True once ``next_offset`` events are committed; False when that takes too long."""
        with self._moved:
            return self._moved.wait_for(lambda: self.next_offset >= next_offset, timeout_s)


def serving_tail_metrics(
    address: tuple[str, int], progress: TailProgress, log: Path
) -> AbstractContextManager[int]:
    """Serve ``/metrics`` for the length of a ``with`` block; yields the port, also for port 0."""
    return serving_values(address, lambda: tail_numbers(progress, log))


def tail_numbers(progress: TailProgress, log: Path) -> Iterator[MetricValue]:
    """Read when somebody scrapes; the lag is against the log as it is then."""
    with LogReader(log) as reader:
        end = reader.next_offset
    yield MetricValue("mapfold_tail_events", "Events written.", progress.events, counter=True)
    yield MetricValue(
        "mapfold_tail_batches", "Transactions committed.", progress.batches, counter=True
    )
    yield MetricValue("mapfold_tail_parked", "Events left out.", progress.parked, counter=True)
    yield MetricValue("mapfold_tail_restarts", "Folds begun anew.", progress.restarts, counter=True)
    yield MetricValue("mapfold_tail_troubles", "Failed attempts.", progress.troubles, counter=True)
    yield MetricValue("mapfold_tail_next_offset", "Events in the databases.", progress.next_offset)
    yield MetricValue("mapfold_tail_log_next_offset", "Events in the log.", end)
    yield MetricValue(
        "mapfold_tail_lag", "Events not yet written.", max(0, end - progress.next_offset)
    )
    if progress.committed_at is not None:
        age = time.monotonic() - progress.committed_at
        yield MetricValue("mapfold_tail_commit_age_seconds", "Since the last commit.", age)
