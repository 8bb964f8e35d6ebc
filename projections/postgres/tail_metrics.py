"""A tail's progress as Prometheus metrics. Apart from `tail_progress`, because importing the
Prometheus client takes a tenth of a short command."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from eventsrc.log import LogReader
from eventsrc.record.metrics import MetricValue, serving_values

from .tail_progress import TailProgress


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
    yield MetricValue("mapfold_tail_restarts", "Folds restarted.", progress.restarts, counter=True)
    yield MetricValue("mapfold_tail_troubles", "Failed attempts.", progress.failures, counter=True)
    yield MetricValue("mapfold_tail_next_offset", "Events in the databases.", progress.next_offset)
    yield MetricValue("mapfold_tail_log_next_offset", "Events in the log.", end)
    yield MetricValue(
        "mapfold_tail_lag", "Events not yet written.", max(0, end - progress.next_offset)
    )
    if progress.committed_at is not None:
        age = time.monotonic() - progress.committed_at
        yield MetricValue("mapfold_tail_commit_age_seconds", "Since the last commit.", age)
