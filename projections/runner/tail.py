"""Tail: keep the databases at the end of the log while it grows.

A tail folds the log from its start, or from the last snapshot below the checkpoints (the fold's
state lives nowhere else), and each sink listens from its own checkpoint on. A batch is what has
come since the last one: one event when little comes, many when it is behind. Each batch is one
transaction per database (`_writing`).

An event that cannot be folded is parked: its offset and the reason go to the dead letters in the
same transaction that moves past it. Parked events stay out at every later start, so that the rows
remain what the fold says, until a rebuild tries them again.
"""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

from eventsrc.log import Event, LogReader, follow
from projections.errors import FoldError, ProjectionMismatch
from projections.folding import WORTH_A_SNAPSHOT
from projections.postgres.connect import Targets, database_errors
from projections.settings import Settings
from projections.sink import Checkpoint, Sink
from projections.sinks import _checkpoint
from projections.sinks._checkpoint import DeadLetter, event_hash
from projections.sinks.loader import LoaderName
from projections.snapshot import SnapshotCache

from ._dead_letters import dead_letter
from ._fold import LiveFold, batches
from ._stores import Only, Store, open_stores
from ._writing import LostCommits, OnTrouble, SinkBatch, Writer
from .progress import TailProgress, TailReport

BATCH_EVENTS: Final = 500
"""At most this many events in one transaction: about half a second of work when behind."""
HEARTBEAT_S: Final = 5.0
ONCE_PATIENCE_S: Final = 60.0


OnBatch = Callable[[TailReport], None]
Note = Callable[[str], None]


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
    on_batch: OnBatch | None = None,
    on_trouble: OnTrouble | None = None,
    note: Note = lambda _: None,
    progress: TailProgress | None = None,
) -> TailReport:
    """Follow ``log`` until ``stop`` is set, or with ``once`` only to its present end.

    ``on_batch`` is called after each commit; ``note`` is told of snapshots that could not be used
    or kept, which costs time and nothing else. Raises ProjectionMismatch when the databases were
    made from another log or with other settings, ProjectionBusy, CheckpointMoved.
    """
    stop = stop or threading.Event()
    report = TailReport()
    while True:
        opened = open_stores(
            targets, settings, only=only, application="mapfold tail", loader=loader
        )
        with opened as stores:
            run = _Run(log, targets, settings, stores, stop, once, report)
            run.batch_events, run.progress = batch_events, progress or run.progress
            run.on_batch, run.on_trouble = on_batch or run.on_batch, on_trouble or run.on_trouble
            run.note = note
            try:
                run.follow()
            except LostCommits:
                report.restarts += 1
            else:
                return report


@dataclass(slots=True)
class _Run:
    """One pass over the log; `tail` begins another when commits were lost."""

    log: Path
    targets: Targets
    settings: Settings
    stores: list[Store]
    stop: threading.Event
    once: bool
    report: TailReport
    batch_events: int = BATCH_EVENTS
    progress: TailProgress = field(default_factory=TailProgress)
    on_batch: OnBatch = lambda _: None
    on_trouble: OnTrouble = lambda _: None
    note: Note = lambda _: None
    checkpoints: dict[str, Checkpoint] = field(default_factory=dict)
    parked: dict[int, DeadLetter] = field(default_factory=dict)
    letters: list[DeadLetter] = field(default_factory=list)

    def follow(self) -> None:
        with LogReader(self.log) as reader:
            self._begin(reader)
            end = reader.next_offset
            cache = SnapshotCache(self.log, reader.log_id, self.settings, self.note)
            fold = LiveFold(self.settings, cache.latest(self._start_at_most()))
            start = fold.map.next_offset
            events: Iterable[Event | None] = (
                reader.read(start, end) if self.once else follow(self.log, start, stop=self.stop)
            )
            patience = ONCE_PATIENCE_S if self.once else None
            writers = [
                Writer(store, self.targets.revive, self.stop, self.on_trouble, patience)
                for store in self.stores
            ]
            beaten = time.monotonic()
            for batch in batches(events, self.batch_events):
                last = self._fold(fold, batch)
                if last is not None:
                    self._write(fold, writers, last)
                if time.monotonic() - beaten > HEARTBEAT_S:
                    beaten = time.monotonic()
                    for writer in writers:
                        writer.beat(list(writer.store.sinks))
                if self.once and self.stop.is_set():
                    break
            if fold.map.next_offset - start >= WORTH_A_SNAPSHOT and not self.parked:
                cache.keep(fold.map, fold.view)

    def _start_at_most(self) -> int:
        """Up to which offset a snapshot is what this tail would fold: another command may have made
        one with events that are parked here."""
        return min([c.next_offset for c in self.checkpoints.values()] + list(self.parked))

    def _begin(self, reader: LogReader) -> None:
        """Make what is missing, read the checkpoints, refuse what does not fit."""
        parked: dict[int, DeadLetter] = {}
        for store in self.stores:
            with database_errors(store.url), store.connection.transaction():
                for sink in store.sinks:
                    sink.ensure(store.connection)
                    _checkpoint.begin(store.connection, sink.name, reader.log_id, self.settings)
                    found = _checkpoint.load(store.connection, sink.name)
                    assert found is not None  # noqa: S101 - begun in this transaction
                    self._check(found, sink, store, reader)
                    self.checkpoints[sink.name] = found
                    letters = _checkpoint.parked(store.connection, sink.name)
                    parked.update((letter.offset, letter) for letter in letters)
        self.parked = parked
        self.report.next_offset = min(c.next_offset for c in self.checkpoints.values())
        self.progress.update(self.report)

    def _check(self, found: Checkpoint, sink: Sink[Any], store: Store, reader: LogReader) -> None:
        _checkpoint.refuse_other_origin(
            found, sink.name, store.place, reader.log_id, self.settings, self._advice()
        )
        if found.next_offset > reader.next_offset:
            raise ProjectionMismatch(
                f"{store.place}: the {sink.name} there hold {found.next_offset} events, but"
                f" {self.log} has only {reader.next_offset}; {self._advice()}"
            )
        for event in reader.read(max(0, found.next_offset - 1), found.next_offset):
            if event_hash(event) != found.last_event:
                raise ProjectionMismatch(
                    f"{self.log}: the event at offset {event.offset} is not the one that the"
                    f" {sink.name} were made from; {self._advice()}"
                )

    def _advice(self) -> str:
        return f"to make them anew run: mapfold replay {self.log}"

    def _fold(self, fold: LiveFold, batch: list[Event]) -> Event | None:
        """Fold a batch; its last event, None for an empty one."""
        rest = batch
        while rest:
            stretch = list(takewhile(lambda event: event.offset not in self.parked, rest))
            for event, error in zip(stretch, fold.feed(stretch, self._due), strict=True):
                if error is not None:
                    self._park(event, error)
            rest = rest[len(stretch) :]
            if rest:
                # Parked by the other sink, which is further: it has to stay out of this one too.
                self.letters.append(self.parked[rest[0].offset])
                fold.skip(rest[0].offset)
                rest = rest[1:]
        return batch[-1] if batch else None

    def _due(self, event: Event) -> list[Sink[Any]]:
        """The sinks that do not have an event yet."""
        return [
            sink
            for store in self.stores
            for sink in store.sinks
            if event.offset >= self.checkpoints[sink.name].next_offset
        ]

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
        next_offset = last.offset + 1
        written = 0
        for writer in writers:
            parts = [
                SinkBatch(
                    sink,
                    sink.take(fold.view),
                    tuple(d for d in self.letters if d.offset >= at.next_offset),
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
            self.progress.update(self.report)
            self.on_batch(self.report)
