"""Tail: keep the databases at the end of the log while it grows.

A tail folds the log from its start, or from the latest fold that was kept below the checkpoints,
and writes to each sink from its own checkpoint on. One pass (`TailPass`) lasts until the tail is
stopped, unless the server loses unflushed commits: then another begins at the checkpoints.

A batch has the events since the last one: a single event at a low rate, up to `BATCH_EVENTS` when
the tail is behind. Each batch is one transaction per database (`batch_writer`).

An event that cannot be folded is parked: its offset and the reason go to the dead letters in the
same transaction that moves past it. Parked events are left out at every later start too, so that
the rows stay equal to the fold, until a rebuild tries them again.

A command changes how earlier events are folded. One that only names places is applied at once, in
the transaction that moves past it. Any other command interrupts the tail: a `refold` folds the log
again, and the tail continues from there. At the start of a pass the checkpoints state which
commands the map includes, so none is lost. If a command moves a keyframe out of bounds, the refold
ends, the old map stays without later events, and the tail waits for another command.
"""

import contextlib
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Final

from eventsrc.envelope.model import Offset
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import Event, LogReader, event_hash, follow
from projections.fold.map_errors import FoldError, ImpossibleCommand, ProjectionMismatch
from projections.fold.settings import Settings
from projections.map.parsing import read_command
from projections.store.history_recorder import HistoryRecorder, resumed_under_other_names
from projections.store.timeline_cache import TimelineCache

from . import checkpoints
from .batch_writer import AWAY, Backoff, LostCommits, TailPlan, TailProgress, TailReport, Writer
from .checkpoints import DeadLetter, dead_letter
from .connection import Targets, database_errors, describe_target
from .inputs import LogInputs, MapInputs, SettingsOf, commands_between
from .labels import SinkName
from .live_fold import LiveFold, batches
from .map_table import maps_key
from .origin import is_under_other_corrections, replay_advice, rows_dropped
from .refold import CommandsCame, Refold, RefoldStopped, refuse_if_not_allowed
from .sink import Checkpoint
from .stores import DatabaseSink, Only, Store, open_stores

BATCH_EVENTS: Final = 500
"""The most events in one transaction: about half a second of work when behind."""
ONCE_TIMEOUT_S: Final = 60.0
"""Seconds that `tail` with ``once`` waits for an unreachable database."""


def tail(
    log: Path,
    targets: Targets,
    settings: Settings | SettingsOf,
    *,
    once: bool = False,
    only: Only = None,
    batch_events: int = BATCH_EVENTS,
    stop: threading.Event | None = None,
    on_fold: Callable[[int], None] = lambda _: None,
    on_batch: Callable[[TailReport], None] = lambda _: None,
    on_trouble: Callable[[str], None] = lambda _: None,
    on_refold: Callable[[int, int], None] = lambda _done, _total: None,
    note: Callable[[str], None] = lambda _: None,
    progress: TailProgress | None = None,
) -> TailReport:
    """Follow ``log`` until ``stop`` is set, or with ``once`` only to its present end.

    ``settings`` may depend on the log's corrections. ``on_batch`` is called after each commit;
    ``on_fold`` is called with the number of events folded and written, at the start of a pass and
    after each batch of it; ``on_refold`` with the number of events that a refold has folded and the
    number that it has to fold. ``note`` is called with a message for each kept history that could
    not be used or written, which costs only time, and for a command that cannot be applied; with
    ``once`` such a command is raised (ImpossibleCommand). Raises ProjectionMismatch when the
    databases were made from another log or with other settings, ProjectionBusy, CheckpointMoved.
    """
    plan = TailPlan(
        log,
        targets,
        settings,
        once,
        stop or threading.Event(),
        ONCE_TIMEOUT_S if once else None,
        batch_events,
        on_fold,
        on_batch,
        on_trouble,
        on_refold,
        note,
        progress or TailProgress(),
    )
    report = TailReport()
    outage: Backoff | None = None
    while True:
        try:
            if _run_pass(plan, report, only, outage):
                return report
        except LostCommits:
            report.restarts += 1
            # The database may be unreachable while the next pass begins.
            outage = Backoff(describe_target(targets.graph_url), plan)


def _run_pass(plan: TailPlan, report: TailReport, only: Only, outage: Backoff | None) -> bool:
    """Run one pass; False when the database was unreachable at its beginning. Raises LostCommits.

    ``outage`` is None for the first pass, which does not wait for an unreachable database.
    """
    run: TailPass | None = None
    try:
        if outage is not None:
            outage.wait()
            plan.targets.restart_embedded()
        with LogReader(plan.log) as reader:
            inputs = LogInputs.read(reader, plan.settings)
            settings = inputs.latest.settings
            with open_stores(
                plan.targets, settings, only=only, application=checkpoints.FOLLOWING
            ) as stores:
                run = TailPass(plan, stores, report, inputs, inputs.latest)
                run.run(reader)
    except AWAY as error:
        if (run is not None and run.began) or outage is None:
            raise
        outage.failed(error)
        return False
    return True


@dataclass(slots=True)
class TailPass:
    """From the checkpoints to the end of the log, or for as long as it grows.

    Call `run`. ``current`` are the inputs of the map. ``parked`` has all dead letters by offset,
    ``letters`` those that are to be written with the next batch. ``recorder`` keeps the history.
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
        writers = self._writers()
        for event in follow(plan.log, known, stop=plan.stop):
            if event is not None and event.key == COMMAND_KEY:
                return True
            for writer in writers:
                writer.beat()
        return False

    def _follow(self, reader: LogReader, folded: LiveFold | None) -> bool:
        """Fold and write what comes; False when a command came that needs a refold.

        ``folded`` is the fold that the databases were made with just now.
        """
        plan = self.plan
        fold = folded or self._resumed(reader)
        start = fold.map.next_offset
        writers = self._writers()
        plan.on_fold(start)
        # Batches end at the checkpoints, so that a sink gets a batch as a whole or not at all.
        cuts = {checkpoint.next_offset for checkpoint in self.checkpoints.values()}
        for batch in batches(self._events(reader, start), plan.batch_events, cuts):
            if not self._knows(batch):
                return False
            last = self._fold(fold, batch)
            if last is not None:
                self._write(fold, writers, reader.log_id, last)
                plan.on_fold(Offset(last.offset + 1))
            for writer in writers:
                writer.beat()
            if plan.once and plan.stop.is_set():
                break
        self._keep(fold)
        return True

    def _resumed(self, reader: LogReader) -> LiveFold:
        """The fold to go on with, from the latest one that was kept below the checkpoints."""
        settings, corrections = self.current.settings, self.current.corrections
        limit, note = self._fold_limit(), self.plan.note
        cache = TimelineCache(reader, settings, corrections, note)
        self.recorder = HistoryRecorder(reader, settings, corrections, cache, None)
        found = resumed_under_other_names(reader, settings, corrections, limit, note)
        is_kept = found is None or found[0].next_offset <= self.recorder.end  # under these names
        writer = self.recorder.writer() if is_kept else None
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
        return [Writer(store, self.checkpoints, self.plan) for store in self.stores]

    def _fold_limit(self) -> Offset:
        """The highest offset a fold to start from may have: the lowest checkpoint or parked event.
        A later one, kept by another command, may have folded the parked event."""
        return min([c.next_offset for c in self.checkpoints.values()] + list(self.parked))

    def _begin(self, reader: LogReader) -> bool:
        """Create what is missing, read the checkpoints, refuse those that do not match.

        False when the map does not include all commands, or was made under other corrections.
        """
        reader.refresh()
        self.inputs = LogInputs.read(reader, self.plan.settings)
        self.parked, faults = {}, False
        for store in self.stores:
            with database_errors(store.url), store.connection.transaction():
                for sink in store.sinks:
                    faults |= self._begin_sink(store, sink, reader)
        self.report.next_offset = min(c.next_offset for c in self.checkpoints.values())
        self.plan.progress.update(self.report)
        # Only the graph has names, so it decides which names the map has now.
        first = self.checkpoints.get("graph") or next(iter(self.checkpoints.values()))
        self.current = self.inputs.at(first.known_at)
        others = [self.inputs.at(c.known_at) for c in self.checkpoints.values()]
        return not faults and all(
            map(self.current.differs_only_in_names, [self.inputs.latest, *others])
        )

    def _begin_sink(self, store: Store, sink: DatabaseSink, reader: LogReader) -> bool:
        """Whether a sink was made under other corrections."""
        connection, latest = store.connection, self.inputs.latest
        made = sink.ensure(connection)
        checkpoints.create(connection, sink.name, latest.checkpoint(reader.log_id))
        found = checkpoints.load(connection, sink.name)
        assert found is not None  # noqa: S101 - created in this transaction
        has_fault = is_under_other_corrections(
            found, sink.name, store.place, self.plan.log, reader, self.inputs
        )
        if made and found.next_offset:
            raise rows_dropped(found, sink.name, store.place, self.plan.log, latest)
        # Now, as `status` reports a sink as followed while its lock is held.
        checkpoints.write_heartbeat(connection, sink.name)
        checkpoints.name_session(connection, checkpoints.FOLLOWING)
        self.checkpoints[sink.name] = found
        self.parked |= {x.offset: x for x in checkpoints.parked(connection, sink.name)}
        return has_fault

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
                f" {replay_advice(self.plan.log, self.current)}"
            )
        letter = dead_letter(event, error.reason)
        self.parked[letter.offset] = letter
        self.letters.append(letter)
        self.report.parked.append(letter)

    def _write(self, fold: LiveFold, writers: list[Writer], log_id: str, last: Event) -> None:
        """Write a batch to the sinks that do not have it yet."""
        self._use_names(fold, last.offset)
        after = self.current.checkpoint(
            log_id, fold.map.next_offset, event_hash(last), maps=maps_key(fold.view)
        )
        changes = fold.tracker.drain()
        written = max(writer.write(changes, fold.view, self.letters, after) for writer in writers)
        self.letters.clear()
        if written:
            self.report.events += written
            self.report.batches += 1
            self.report.next_offset = after.next_offset
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
