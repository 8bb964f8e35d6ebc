"""One pass of a tail, from the checkpoints to the end of the log; `tail` has the rules."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Final, TypeAlias

from eventsrc.envelope.model import Offset
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import Event, LogReader, event_hash, follow
from projections.fold.errors import FoldError, ImpossibleCommand, ProjectionMismatch
from projections.fold.settings import Settings
from projections.map.own_events import read_command
from projections.store.column_rows import TableWriter
from projections.store.history_recorder import HistoryRecorder, resumed_under_other_names
from projections.store.timeline_cache import TimelineCache

from . import checkpoints
from .checkpoints import DeadLetter, dead_letter
from .connection import Targets, database_errors
from .inputs import LogInputs, MapInputs, SettingsOf, commands_between
from .live_fold import LiveFold, batches
from .map_rows import maps_key
from .origin import origin_fault, refuse_mismatch, refuse_other_events, replay_advice, rows_dropped
from .refold import CommandsCame, Refold, RefoldStopped, refuse_if_not_allowed
from .sink import Checkpoint, SinkName
from .stores import Store
from .tail_progress import TailProgress, TailReport
from .writer import AWAY, LostCommits, OnTrouble, SinkBatch, Writer

HEARTBEAT_S: Final = 5.0

OnBatch: TypeAlias = Callable[[TailReport], None]
OnRefold: TypeAlias = Callable[[int, int], None]
Note: TypeAlias = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class TailPlan:
    """The arguments of `tail`."""

    log: Path
    targets: Targets
    settings: Settings | SettingsOf
    once: bool
    stop: threading.Event
    patience_s: float | None
    batch_events: int
    on_fold: Callable[[int], None]
    on_batch: OnBatch
    on_trouble: OnTrouble
    on_refold: OnRefold
    note: Note
    progress: TailProgress


@dataclass(slots=True)
class TailPass:
    """From the checkpoints to the end of the log, or for as long as it grows.

    Call `run`. ``current`` are the inputs of the map. ``parked`` has all dead letters by offset,
    ``letters`` those that are to be written with the next batch. ``recorder`` keeps what is
    folded.
    """

    plan: TailPlan
    stores: list[Store]
    report: TailReport
    inputs: LogInputs
    current: MapInputs
    checkpoints: dict[SinkName, Checkpoint] = field(default_factory=dict)
    parked: dict[Offset, DeadLetter] = field(default_factory=dict)
    letters: list[DeadLetter] = field(default_factory=list)
    began: bool = False
    recorder: HistoryRecorder | None = None

    def run(self, reader: LogReader) -> None:
        """Follow the log, and refold when commands make it necessary.

        Raises LostCommits, CheckpointMoved, ProjectionMismatch, ImpossibleCommand.
        """
        fold, restarts = None, 0
        while True:
            with self._lost_connections():
                is_current = self._begin(reader)
            self.began = True
            if is_current:
                if self._follow(reader, fold):
                    return
                fold, restarts = None, 0
            else:
                fold, known = None, self.inputs.end  # free the old one first
                try:
                    with self._lost_connections():
                        fold = self._refold(reader, goes_through=restarts > 0)
                    restarts = 0
                except CommandsCame:
                    restarts += 1
                except RefoldStopped:
                    return
                except ImpossibleCommand as error:
                    restarts = 0
                    if not self._outwait(error, reader, known):
                        return

    @contextlib.contextmanager
    def _lost_connections(self) -> Iterator[None]:
        """Turn a lost connection into LostCommits: the next pass begins at the checkpoints. At the
        beginning of the first pass it is an error."""
        try:
            yield
        except AWAY as error:
            if not self.began:
                raise
            self.plan.on_trouble(str(error))
            raise LostCommits from error

    def _refold(self, reader: LogReader, *, goes_through: bool) -> LiveFold:
        plan = self.plan
        refuse_if_not_allowed(self.stores, replay_advice(plan.log, self.inputs.latest))
        folded = Refold(
            self.stores,
            reader,
            self.inputs,
            self.checkpoints,
            bool(self.parked),
            plan.stop,
            goes_through,
            plan.on_refold,
        ).run()
        self.report.refolds += 1
        self.report.parked += [x for x in folded.letters if x.offset not in self.parked]
        return folded.fold

    def _outwait(self, error: ImpossibleCommand, reader: LogReader, known: Offset) -> bool:
        """Leave the old map as it is until a command at ``known`` or later is in the log; False
        when stopped. With ``once`` it raises the error instead of waiting."""
        plan = self.plan
        with self._lost_connections():
            self._begin(reader)  # which also ends the refold for `status`
        if plan.once:
            if not commands_between(reader, known, reader.next_offset):
                raise error
            return True
        plan.progress.count_failure()
        plan.note(f"mapfold: {error}; until another command comes the old map stays as it is")
        writers, last_beat = self._writers(), time.monotonic()
        for event in follow(plan.log, known, stop=plan.stop):
            if event is not None and event.key == COMMAND_KEY:
                return True
            if time.monotonic() - last_beat > HEARTBEAT_S:
                last_beat = time.monotonic()
                for writer in writers:
                    writer.write_heartbeat()
        return False

    def _follow(self, reader: LogReader, folded: LiveFold | None) -> bool:
        """Fold and write what comes; False when a command came that needs a refold.

        ``folded`` is the fold that the databases were made with just now.
        """
        plan = self.plan
        fold = folded or self._resumed(reader)
        start = fold.map.next_offset
        writers = self._writers()
        last_beat = time.monotonic()
        plan.on_fold(start)
        for batch in batches(
            self._events(reader, start), plan.batch_events, self._checkpoint_offsets()
        ):
            if not self._knows(batch):
                return False
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
        self._keep(fold)
        return True

    def _resumed(self, reader: LogReader) -> LiveFold:
        """The fold to go on with, from the latest one that was kept below the checkpoints."""
        current, note = self.current, self.plan.note
        settings, corrections = current.settings, current.corrections
        cache = TimelineCache(reader, settings, corrections, note)
        self.recorder = HistoryRecorder(reader, settings, corrections, cache, None)
        found = resumed_under_other_names(reader, settings, corrections, self._fold_limit(), note)
        writer: TableWriter | None = self.recorder.writer()
        if found is not None and found[0].next_offset > self.recorder.end:  # of other names
            writer = None
        return LiveFold(settings, found, corrections=corrections, reader=reader, writer=writer)

    def _keep(self, fold: LiveFold) -> None:
        """Keep the history that was folded, to go on from the next time."""
        if self.recorder is not None and fold.writer is not None:
            self.recorder.keep(fold.writer, fold.map)
            fold.writer = None

    def _knows(self, batch: Sequence[Event]) -> bool:
        """Record the commands of a batch; False when they change more than names."""
        commands = [
            read_command(event)
            for event in batch
            if event.key == COMMAND_KEY and event.offset >= self.inputs.end
        ]
        if not commands:
            return True
        self.inputs.extend(commands, Offset(batch[-1].offset + 1))
        return self.current.differs_only_in_names(self.inputs.latest)

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

    def _fold_limit(self) -> Offset:
        """The highest offset a fold to start from may have: the lowest checkpoint or parked event.
        A later one, kept by another command, may have folded the parked event."""
        return min([c.next_offset for c in self.checkpoints.values()] + list(self.parked))

    def _begin(self, reader: LogReader) -> bool:
        """Create what is missing, read the checkpoints, refuse those that do not match.

        False when the map does not include all commands, or was made under other corrections.
        """
        plan = self.plan
        reader.refresh()
        self.inputs = LogInputs.read(reader, plan.settings)
        parked: dict[Offset, DeadLetter] = {}
        faults = False
        for store in self.stores:
            with database_errors(store.url), store.connection.transaction():
                for sink in store.sinks:
                    made = sink.ensure(store.connection)
                    checkpoints.create(
                        store.connection, sink.name, reader.log_id, self.inputs.latest
                    )
                    found = checkpoints.load(store.connection, sink.name)
                    assert found is not None  # noqa: S101 - created in this transaction
                    faults |= self._refuse_mismatch(found, sink.name, store.place, reader)
                    if made and found.next_offset:
                        raise rows_dropped(
                            found, sink.name, store.place, plan.log, self.inputs.latest
                        )
                    # Now, as `status` reports a sink as followed while its lock is held.
                    checkpoints.write_refold(store.connection, sink.name, None, None)
                    self.checkpoints[sink.name] = found
                    letters = checkpoints.parked(store.connection, sink.name)
                    parked.update((letter.offset, letter) for letter in letters)
        self.parked = parked
        self.report.next_offset = min(c.next_offset for c in self.checkpoints.values())
        self.plan.progress.update(self.report)
        # Only the graph has names, so it decides which names the map has now.
        first = self.checkpoints.get("graph") or next(iter(self.checkpoints.values()))
        self.current = self.inputs.at(first.known_to)
        return not faults and all(
            self.current.differs_only_in_names(other)
            for other in (
                self.inputs.latest,
                *(self.inputs.at(c.known_to) for c in self.checkpoints.values()),
            )
        )

    def _refuse_mismatch(
        self, found: Checkpoint, sink: SinkName, where: str, reader: LogReader
    ) -> bool:
        """Raise ProjectionMismatch for another log or settings; True for other corrections."""
        log, inputs = self.plan.log, self.inputs.at(found.known_to)
        if origin_fault(found, reader.log_id, inputs) != "corrections":
            refuse_mismatch(found, sink, where, log, reader, inputs)
            return False
        advice = replay_advice(log, self.inputs.latest)
        refuse_other_events(found, sink, where, log, reader, advice)
        return True

    def _advice(self) -> str:
        return replay_advice(self.plan.log, self.current)

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
        self._use_names(fold, last.offset)
        changes, maps = fold.tracker.drain(), maps_key(fold.view)
        written = 0
        for writer in writers:
            parts = [
                SinkBatch(
                    sink,
                    sink.prepare(changes, fold.view),
                    tuple(self.letters),
                    at,
                    checkpoints.at_offset(
                        at.log_id, self.current, next_offset, event_hash(last), maps=maps
                    ),
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

    def _use_names(self, fold: LiveFold, offset: Offset) -> None:
        """Apply the names given by the commands up to ``offset``; between a command that changes
        more and the one that undoes it the map stays as known before both."""
        known_at = Offset(max(self.current.known_at, offset + 1))
        if not self.inputs.has_between(self.current.known_at, known_at):
            self.current = self.current.known_to(known_at)
            return
        known = self.inputs.at(known_at)
        if self.current.differs_only_in_names(known):
            self.current = known
            self._keep(fold)
            fold.use_names(offset, known.corrections)
