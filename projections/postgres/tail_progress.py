"""Options, report and progress of a tail. Other threads read the progress and wait for it, and
Prometheus scrapes it."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.fold.settings import Settings

from .checkpoints import DeadLetter
from .connection import Targets
from .inputs import SettingsOf


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


@dataclass(frozen=True, slots=True)
class TailPlan:
    """The arguments of `tail`. ``patience_s`` are the seconds that it waits for an unreachable
    database, None for ever."""

    log: Path
    targets: Targets
    settings: Settings | SettingsOf
    once: bool
    stop: threading.Event
    patience_s: float | None
    batch_events: int
    on_fold: Callable[[int], None]
    on_batch: Callable[[TailReport], None]
    on_trouble: Callable[[str], None]
    on_refold: Callable[[int, int], None]
    note: Callable[[str], None]
    progress: TailProgress


@contextmanager
def serving_tail_metrics(
    address: tuple[str, int], progress: TailProgress, log: Path
) -> Iterator[int]:
    """Serve ``/metrics`` for the length of a ``with`` block; yields the port, also for port 0.

    The lag is counted from the log's end at the time of a scrape.
    """
    # Imported here, as the Prometheus client takes a tenth of a short command.
    from eventsrc.record.metrics import MetricValue, serving_values

    def numbers() -> Iterator[MetricValue]:
        with LogReader(log) as reader:
            end = reader.next_offset
        for name, text, count in (
            ("events", "Events written.", progress.events),
            ("batches", "Transactions committed.", progress.batches),
            ("parked", "Events left out.", progress.parked),
            ("restarts", "Folds restarted.", progress.restarts),
            ("troubles", "Failed attempts.", progress.failures),
        ):
            yield MetricValue(f"mapfold_tail_{name}", text, count, counter=True)
        at = progress.next_offset
        yield MetricValue("mapfold_tail_next_offset", "Events in the databases.", at)
        yield MetricValue("mapfold_tail_log_next_offset", "Events in the log.", end)
        yield MetricValue("mapfold_tail_lag", "Events not yet written.", max(0, end - at))
        if progress.committed_at is not None:
            age = time.monotonic() - progress.committed_at
            yield MetricValue("mapfold_tail_commit_age_seconds", "Since the last commit.", age)

    with serving_values(address, numbers) as port:
        yield port
