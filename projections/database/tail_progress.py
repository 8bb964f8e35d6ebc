"""A tail's progress, for other threads and for Prometheus."""

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
    """What a tail did so far: batches and events written, its offset, what it parked, and how
    often it made the map anew because of commands."""

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


def serving_tail_metrics(
    address: tuple[str, int], progress: TailProgress, log: Path
) -> AbstractContextManager[int]:
    """Serve ``/metrics`` for the length of a ``with`` block; yields the port, also for port 0."""
    return serving_values(address, lambda: tail_numbers(progress, log))


def tail_numbers(progress: TailProgress, log: Path) -> Iterator[MetricValue]:
    """The metrics at the time of a scrape; the lag is counted from the log's end then."""
    with LogReader(log) as reader:
        end = reader.next_offset
    yield MetricValue("mapfold_tail_events", "Events written.", progress.events, counter=True)
    yield MetricValue(
        "mapfold_tail_batches", "Transactions committed.", progress.batches, counter=True
    )
    yield MetricValue("mapfold_tail_parked", "Events left out.", progress.parked, counter=True)
    yield MetricValue("mapfold_tail_restarts", "Folds begun anew.", progress.restarts, counter=True)
    yield MetricValue("mapfold_tail_troubles", "Failed attempts.", progress.failures, counter=True)
    yield MetricValue("mapfold_tail_next_offset", "Events in the databases.", progress.next_offset)
    yield MetricValue("mapfold_tail_log_next_offset", "Events in the log.", end)
    yield MetricValue(
        "mapfold_tail_lag", "Events not yet written.", max(0, end - progress.next_offset)
    )
    if progress.committed_at is not None:
        age = time.monotonic() - progress.committed_at
        yield MetricValue("mapfold_tail_commit_age_seconds", "Since the last commit.", age)
