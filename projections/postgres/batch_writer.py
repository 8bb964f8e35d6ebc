"""Write each batch exactly once, also when the server restarts or the connection breaks.

Rows and checkpoint move in one transaction, the checkpoint by compare-and-set. When a transaction
fails because the server or the connection did, it is unknown whether it was committed. So the batch
is kept, the writer connects again (with exponential back-off) and reads the checkpoint:

* it is where the batch begins: the batch was not committed; write it again
* it is where the batch ends: it was committed, only the answer was lost; go on
* it is before that: the server lost commits it had not yet flushed (``synchronous_commit = off``);
  the rows went with it, so fold again from there (`LostCommits`)
* anything else: another program writes; stop (CheckpointMoved)

A heartbeat that finds the connection lost is treated as an empty batch, for every sink of the
store, so that a commit that was lost while no event came is noticed.

Here are also the options, report and progress of a tail. Other threads read the progress and wait
for it, and Prometheus scrapes it.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.fold import map_errors
from projections.fold.settings import Settings
from projections.map.changes import BatchChanges
from projections.map.view import MapView

from . import checkpoints
from .checkpoints import DeadLetter
from .connection import Connection, Targets, database_errors
from .inputs import SettingsOf
from .labels import SinkName
from .sink import Checkpoint, PreparedWrite
from .stores import Store


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


AWAY: Final = (map_errors.DatabaseUnavailable, map_errors.EmbeddedServerError)
"""Errors after which another attempt may succeed. EmbeddedServerError is raised for a server killed
during its start."""
FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0
HEARTBEAT_S: Final = 5.0


@dataclass(slots=True)
class Backoff:
    """Growing pauses during one outage."""

    place: str
    plan: TailPlan
    pause_s: float = FIRST_PAUSE_S
    waited_s: float = 0.0

    def wait(self) -> None:
        """Wait before the next attempt. Raises DatabaseUnavailable when stopped meanwhile."""
        if self.plan.stop.wait(self.pause_s):
            raise map_errors.DatabaseUnavailable(
                f"{self.place}: stopped while the database was away; what was not written yet is in"
                " the log and comes with the next start"
            )

    def failed(self, error: map_errors.DatabaseError) -> None:
        """Report a failed attempt and double the next pause. Raises it after ``patience_s``."""
        self.waited_s += self.pause_s
        patience_s = self.plan.patience_s
        if patience_s is not None and self.waited_s > patience_s:
            raise error
        self.plan.on_trouble(str(error))
        self.pause_s = min(self.pause_s * 2, LONGEST_PAUSE_S)


class LostCommits(Exception):
    """The server lost commits: fold again from its checkpoint."""


@dataclass(slots=True)
class Writer:
    """Writes to one store.

    ``checkpoints`` are the last known ones of all sinks; `write` moves those of this store.
    """

    store: Store
    checkpoints: dict[SinkName, Checkpoint]
    plan: TailPlan
    _beaten: float = field(default_factory=time.monotonic)

    def write(
        self,
        changes: BatchChanges,
        view: MapView,
        letters: Sequence[DeadLetter],
        after: Checkpoint,
    ) -> int:
        """Commit a batch for the sinks that are not at ``after`` yet, with its dead letters.

        Returns the most events that one of them got.
        """
        starts = {
            sink.name: self.checkpoints[sink.name].next_offset
            for sink in self.store.sinks
            if self.checkpoints[sink.name].next_offset < after.next_offset
        }
        writes = {
            sink.name: sink.prepare(changes, view)
            for sink in self.store.sinks
            if sink.name in starts
        }
        if writes:
            self._until_committed(
                lambda: self._transaction(writes, letters, after),
                dict.fromkeys(writes, after.next_offset),
            )
        return max((after.next_offset - start for start in starts.values()), default=0)

    def beat(self) -> None:
        """Record every `HEARTBEAT_S` that the tail is alive; a lost connection is made again.

        Raises LostCommits when the server came back without what it had committed.
        """
        if time.monotonic() - self._beaten > HEARTBEAT_S:
            self._beaten = time.monotonic()
            self._until_committed(self._beat, {})

    def _beat(self) -> None:
        for sink in self.store.sinks:
            checkpoints.write_heartbeat(self.store.connection, sink.name)

    def _until_committed(
        self, transaction: Callable[[], None], ends: Mapping[SinkName, Offset]
    ) -> None:
        """Run a transaction that moves checkpoints to ``ends``, until it is committed."""
        while True:
            try:
                with database_errors(self.store.url):
                    transaction()
                    return
            except map_errors.DatabaseUnavailable as error:
                self.plan.on_trouble(str(error))
            if self._was_committed(self._reconnect(), ends):
                return

    def _transaction(
        self,
        writes: Mapping[SinkName, PreparedWrite[Connection]],
        letters: Sequence[DeadLetter],
        after: Checkpoint,
    ) -> None:
        connection = self.store.connection
        # A pipeline takes two round trips instead of twenty, which is most of the delay of a live
        # tail. COPY cannot be part of one.
        is_small = all(write.is_small for write in writes.values())
        with (
            connection.pipeline() if is_small else contextlib.nullcontext(),
            connection.transaction(),
        ):
            for sink, write in writes.items():
                write.send(connection)
                for letter in letters:
                    checkpoints.park(connection, sink, letter)
            for sink in writes:
                checkpoints.advance(connection, sink, self.checkpoints[sink], after)
        self.checkpoints.update(dict.fromkeys(writes, after))

    def _reconnect(self) -> dict[SinkName, Checkpoint | None]:
        """Make a new connection; returns the checkpoints there."""
        backoff = Backoff(self.store.place, self.plan)
        while True:
            backoff.wait()
            try:
                self.plan.targets.restart_embedded()
                self.store.reconnect()
                return self._read_checkpoints()
            except AWAY as error:
                backoff.failed(error)

    def _read_checkpoints(self) -> dict[SinkName, Checkpoint | None]:
        connection = self.store.connection
        found: dict[SinkName, Checkpoint | None] = {}
        with database_errors(self.store.url), connection.transaction():
            for sink in self.store.sinks:
                # A transaction that was rolled back may have changed the sink's state.
                if sink.ensure(connection):
                    raise LostCommits  # all rows are gone; the next pass reports why
                found[sink.name] = checkpoints.load(connection, sink.name)
        return found

    def _was_committed(
        self, found: Mapping[SinkName, Checkpoint | None], ends: Mapping[SinkName, Offset]
    ) -> bool:
        """Whether the checkpoints found are at ``ends``; False if they are as before.

        Raises LostCommits, CheckpointMoved.
        """
        if all(_is_same(now, self.checkpoints[sink]) for sink, now in found.items()):
            return False
        for sink, now in found.items():
            before = self.checkpoints[sink]
            if now is None or now.next_offset < before.next_offset:
                raise LostCommits
            if now.next_offset != ends.get(sink, before.next_offset):
                raise map_errors.CheckpointMoved(
                    f"{self.store.place}: after the connection was lost the checkpoint of the"
                    f" {sink} is at {now.next_offset:,}, which this tail never wrote: something"
                    " else writes there; stop it, then start again"
                )
            if sink in ends:
                self.checkpoints[sink] = now
        return True


def _is_same(found: Checkpoint | None, ours: Checkpoint) -> bool:
    """Whether they are equal but for the digest, which only a rebuild writes."""
    return found is not None and replace(found, digest=ours.digest) == ours
