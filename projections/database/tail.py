"""Tail: keep the databases at the end of the log while it grows.

A tail folds the log from its start, or from the last snapshot below the checkpoints (the fold's
state is kept nowhere else), and writes to each sink from its own checkpoint on. One pass
(`TailPass`) lasts until the tail is stopped, unless the server loses commits that it had not
flushed: then the fold is ahead of the databases, and another pass begins at their checkpoints.

A batch is what has come since the last one: one event when little comes, up to `BATCH_EVENTS` when
the tail is behind. Each batch is one transaction per database (`writer`).

An event that cannot be folded is parked: its offset and the reason go to the dead letters in the
same transaction that moves past it. Parked events are left out at every later start too, so that
the rows remain what the fold says, until a rebuild tries them again.
"""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Final, TypeAlias

from eventsrc.envelope import Offset
from eventsrc.log import Event, LogReader, follow
from projections.errors import FoldError, ProjectionMismatch
from projections.model.fold import SNAPSHOT_MIN_EVENTS
from projections.model.snapshot_cache import SnapshotCache
from projections.settings import Settings

from . import checkpoints
from .checkpoints import DeadLetter, dead_letter, event_hash
from .connection import Targets, database_errors, describe_target
from .live_fold import LiveFold, batches
from .loader import LoaderName
from .origin import refuse_mismatch, replay_advice, rows_dropped
from .sink import Checkpoint, SinkName
from .stores import Only, Store, open_stores
from .tail_progress import TailProgress, TailReport
from .writer import AWAY, Backoff, LostCommits, OnTrouble, SinkBatch, Writer

BATCH_EVENTS: Final = 500
"""At most this many events in one transaction: about half a second of work when behind."""
ONCE_PATIENCE_S: Final = 60.0
"""How long `tail` with ``once`` waits for a database that is away."""
HEARTBEAT_S: Final = 5.0

OnBatch: TypeAlias = Callable[[TailReport], None]
Note: TypeAlias = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class TailPlan:
    """The arguments of `tail`."""

    log: Path
    targets: Targets
    settings: Settings
    once: bool
    stop: threading.Event
    patience_s: float | None
    batch_events: int
    on_fold: Callable[[int], None]
    on_batch: OnBatch
    on_trouble: OnTrouble
    note: Note
    progress: TailProgress


@dataclass(slots=True)
class TailPass:
    """From the checkpoints to the end of the log, or for as long as it grows.

    Call `begin`, then `follow`. ``parked`` has all dead letters by offset, ``letters`` those that
    are to be written with the next batch.
    """

    plan: TailPlan
    stores: list[Store]
    report: TailReport
    checkpoints: dict[SinkName, Checkpoint] = field(default_factory=dict)
    parked: dict[Offset, DeadLetter] = field(default_factory=dict)
    letters: list[DeadLetter] = field(default_factory=list)

    def follow(self, reader: LogReader) -> None:
        """Fold and write what comes. Raises LostCommits, CheckpointMoved, ProjectionMismatch."""
        plan = self.plan
        cache = SnapshotCache(plan.log, reader.log_id, plan.settings, plan.note)
        fold = LiveFold(plan.settings, cache.latest(self._latest_usable_snapshot()))
        start = fold.map.next_offset
        writers = self._writers()
        last_beat = time.monotonic()
        plan.on_fold(start)
        for batch in batches(
            self._events(reader, start), plan.batch_events, self._checkpoint_offsets()
        ):
            last = self._fold(fold, batch)
            if last is not None:
                self._write(fold, writers, last)
                plan.on_fold(Offset(last.offset + 1))
            if time.monotonic() - last_beat > HEARTBEAT_S:
                last_beat = time.monotonic()
                for writer in writers:
                    writer.write_heartbeat()
            if plan.once and plan.stop.is_set():
                break
        if fold.map.next_offset - start >= SNAPSHOT_MIN_EVENTS and not self.parked:
            cache.keep(fold.map, fold.view)

    def _events(self, reader: LogReader, start: Offset) -> Iterable[Event | None]:
        if self.plan.once:
            return reader.read(start, reader.next_offset)
        return follow(self.plan.log, start, stop=self.plan.stop)

    def _writers(self) -> list[Writer]:
        plan = self.plan
        return [
            Writer(
                store,
                self.checkpoints,
                plan.targets.restart_embedded,
                plan.stop,
                plan.on_trouble,
                plan.patience_s,
            )
            for store in self.stores
        ]

    def _checkpoint_offsets(self) -> set[Offset]:
        """Batches end there, so that a sink gets a batch as a whole or not at all."""
        return {checkpoint.next_offset for checkpoint in self.checkpoints.values()}

    def _latest_usable_snapshot(self) -> Offset:
        """The highest offset of a snapshot to start from: below all checkpoints and parked events,
        which another command may have folded."""
        return min([c.next_offset for c in self.checkpoints.values()] + list(self.parked))

    def begin(self, reader: LogReader) -> None:
        """Create what is missing, read the checkpoints, refuse those that do not match."""
        plan = self.plan
        parked: dict[Offset, DeadLetter] = {}
        for store in self.stores:
            with database_errors(store.url), store.connection.transaction():
                for sink in store.sinks:
                    made = sink.ensure(store.connection)
                    checkpoints.create(store.connection, sink.name, reader.log_id, plan.settings)
                    found = checkpoints.load(store.connection, sink.name)
                    assert found is not None  # noqa: S101 - begun in this transaction
                    refuse_mismatch(found, sink.name, store.place, plan.log, reader, plan.settings)
                    if made and found.next_offset:
                        raise rows_dropped(found, sink.name, store.place, plan.log, plan.settings)
                    # Now, as with the lock held `status` takes the sink for followed.
                    checkpoints.write_heartbeat(store.connection, sink.name)
                    self.checkpoints[sink.name] = found
                    letters = checkpoints.parked(store.connection, sink.name)
                    parked.update((letter.offset, letter) for letter in letters)
        self.parked = parked
        self.report.next_offset = min(c.next_offset for c in self.checkpoints.values())
        self.plan.progress.update(self.report)

    def _advice(self) -> str:
        return replay_advice(self.plan.log, self.plan.settings)

    def _fold(self, fold: LiveFold, batch: list[Event]) -> Event | None:
        """Fold a batch; returns its last event, None for an empty one."""
        rest = batch
        while rest:
            stretch = list(takewhile(lambda event: event.offset not in self.parked, rest))
            for event, error in zip(stretch, fold.feed(stretch), strict=True):
                if error is not None:
                    self._park(event, error)
            rest = rest[len(stretch) :]
            if rest:
                # Parked by the other sink, which is ahead: leave it out of this one too.
                self.letters.append(self.parked[rest[0].offset])
                fold.skip(rest[0].offset)
                rest = rest[1:]
        return batch[-1] if batch else None

    def _park(self, event: Event, error: FoldError) -> None:
        if any(event.offset < c.next_offset for c in self.checkpoints.values()):
            raise ProjectionMismatch(
                f"{error}, but it is in the databases already: they were made by another version;"
                f" {self._advice()}"
            )
        letter = dead_letter(event, error.reason)
        self.parked[letter.offset] = letter
        self.letters.append(letter)
        self.report.parked.append(letter)

    def _write(self, fold: LiveFold, writers: list[Writer], last: Event) -> None:
        """Write a batch to the sinks that do not have it yet."""
        next_offset = Offset(last.offset + 1)
        changes = fold.tracker.drain()
        written = 0
        for writer in writers:
            parts = [
                SinkBatch(
                    sink,
                    sink.prepare(changes, fold.view),
                    tuple(self.letters),
                    at,
                    next_offset,
                    event_hash(last),
                )
                for sink in writer.store.sinks
                if (at := self.checkpoints[sink.name]).next_offset < next_offset
            ]
            if parts:
                for part, after in zip(parts, writer.write(parts), strict=True):
                    written = max(written, after.next_offset - part.before.next_offset)
                    self.checkpoints[part.sink.name] = after
        self.letters.clear()
        if written:
            self.report.events += written
            self.report.batches += 1
            self.report.next_offset = next_offset
            self.plan.progress.update(self.report)
            self.plan.on_batch(self.report)


def tail(
    log: Path,
    targets: Targets,
    settings: Settings,
    *,
    once: bool = False,
    only: Only = None,
    loader: LoaderName = "copy",
    batch_events: int = BATCH_EVENTS,
    stop: threading.Event | None = None,
    on_fold: Callable[[int], None] = lambda _: None,
    on_batch: OnBatch = lambda _: None,
    on_trouble: OnTrouble = lambda _: None,
    note: Note = lambda _: None,
    progress: TailProgress | None = None,
) -> TailReport:
    """Follow ``log`` until ``stop`` is set, or with ``once`` only to its present end.

    ``on_batch`` is called after each commit; ``on_fold`` is told how many events are folded and
    written, at the start of a pass and after each batch of it; ``note`` is told of snapshots that
    could not be used or kept, which costs time and nothing else. Raises ProjectionMismatch when the
    databases were made from another log or with other settings, ProjectionBusy, CheckpointMoved.
    """
    plan = TailPlan(
        log,
        targets,
        settings,
        once,
        stop or threading.Event(),
        ONCE_PATIENCE_S if once else None,
        batch_events,
        on_fold,
        on_batch,
        on_trouble,
        note,
        progress or TailProgress(),
    )
    report = TailReport()
    outage: Backoff | None = None
    while True:
        try:
            if _run_pass(plan, report, only, loader, outage):
                return report
        except LostCommits:
            report.restarts += 1
            # The database may be away while the next pass begins.
            at = describe_target(targets.graph_url)
            outage = Backoff(at, plan.stop, on_trouble, plan.patience_s)


def _run_pass(
    plan: TailPlan, report: TailReport, only: Only, loader: LoaderName, outage: Backoff | None
) -> bool:
    """Run one pass; False when the database was away at its beginning. Raises LostCommits.

    ``outage`` is None for the first pass, which does not wait for a database that is away.
    """
    begun = False
    try:
        if outage is not None:
            outage.wait()
            plan.targets.restart_embedded()
        opened = open_stores(
            plan.targets, plan.settings, only=only, application="mapfold tail", loader=loader
        )
        with opened as stores, LogReader(plan.log) as reader:
            run = TailPass(plan, stores, report)
            run.begin(reader)
            begun = True
            run.follow(reader)
    except AWAY as error:
        if begun or outage is None:
            raise
        outage.failed(error)
        return False
    return True
