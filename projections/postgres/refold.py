"""Refold: a tail folds the log again under other corrections while readers use the old map.

It is a rebuild (`shadows`) over the tail's own connections and locks, with three differences. It
continues until it has folded all events recorded meanwhile. An event that cannot be folded is
parked, as by a tail; but one that cannot be folded only because of a command ends the refold, and
the old map stays. And it polls for commands recorded during the refold: those that only name places
are included; another one restarts it once. After that it is completed before the next refold
begins, so that frequent commands cannot prevent every change of the map. Rows of vectors that no
correction changes are kept (`KeptVectors`).

The transaction of the swap records in the checkpoint which commands the new map includes. However a
refold ends, a command that the map does not include makes the next tail refold.

That there is one shows in the name of the tail's sessions (`checkpoints.name_session`), which other
processes see at once, also while the refold is in the transaction of its swap.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

from eventsrc.base.machine import gc_paused
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader
from projections.fold.map_errors import DatabaseError, ImpossibleCommand
from projections.map.changes import BatchChanges
from projections.map.view import MapView

from . import checkpoints
from .checkpoints import DeadLetter, dead_letter
from .connection import Connection, database_errors, describe_connection, statements
from .inputs import LogInputs, MapInputs, commands_between
from .labels import SINKS, TABLE, SinkName
from .live_fold import LiveFold, batches
from .shadows import FoldedLog, ShadowOf, ShadowWriter, drop_replaced, stream, swap_in_new_map
from .sink import Checkpoint, Shadow
from .stores import DatabaseSink, Store
from .vector_sink import READERS, count_vectors, has_hnsw

TICK_EVENTS: Final = 256
LOOK_S: Final = 0.5
"""Seconds between two polls for new commands."""


class CommandsCame(Exception):
    """Commands that change more than names were recorded during a refold."""


class RefoldStopped(Exception):
    """The tail was stopped during a refold; the old map stays."""


@dataclass(slots=True)
class Refold:
    """One refold. ``found`` are the checkpoints of the old map, ``parked`` its dead letters.

    With ``goes_through`` commands recorded meanwhile are left to the next refold.
    """

    stores: Sequence[Store]
    reader: LogReader
    inputs: LogInputs
    found: dict[SinkName, Checkpoint]
    parked: bool
    stop: threading.Event
    goes_through: bool
    on_progress: Callable[[int, int], None]
    base: MapInputs = field(init=False)
    _letters: list[DeadLetter] = field(default_factory=list)
    _looked_at: float = 0.0

    def run(self) -> FoldedLog:
        """Fold the log again and swap the new map in.

        Raises CommandsCame, RefoldStopped, ImpossibleCommand.
        """
        self.base = self.inputs.latest
        folded: list[FoldedLog] = []

        def fold_into(writers: Sequence[ShadowWriter]) -> FoldedLog:
            folded.append(self._fold(writers))
            return folded[0]

        indexed = self._swaps_indexed_vectors()
        for store in self.stores:
            store.run(partial(checkpoints.name_session, name=checkpoints.REFOLDING))
        with gc_paused():
            swap_in_new_map(
                self.stores,
                self.reader.log_id,
                fold_into,
                lambda _: None,
                shadow_of=self._shadow_of(),
            )
            drop_replaced(self.stores, lambda _: None, hnsw=indexed)
        return folded[0]

    def _fold(self, writers: Sequence[ShadowWriter]) -> FoldedLog:
        fold = LiveFold(self.base.settings, corrections=self.base.corrections, reader=self.reader)
        last: Event | None = None
        at, end = FIRST_OFFSET, self.inputs.end
        with LogReader(self.reader.path) as events:
            while at < end:
                for batch in batches(events.read(at, end), TICK_EVENTS):
                    self._feed(fold, batch)
                    last = batch[-1]
                    stream(fold, writers)
                    self.on_progress(last.offset + 1, end)
                    if time.monotonic() - self._looked_at > LOOK_S:
                        self._look()
                at, end = end, self._look()
                events.refresh()
        return FoldedLog(fold, last, self._named(fold, last), tuple(self._letters))

    def _feed(self, fold: LiveFold, batch: list[Event]) -> None:
        if self.stop.is_set():
            raise RefoldStopped
        for event, error in zip(batch, fold.feed(batch), strict=True):
            if isinstance(error, ImpossibleCommand):
                raise error
            if error is not None:
                self._letters.append(dead_letter(event, error.reason))

    def _look(self) -> Offset:
        """Read new commands; returns the log's current end."""
        self._looked_at = time.monotonic()
        start, end = self.inputs.end, self.reader.refresh()
        self.inputs.extend(commands_between(self.reader, start, end), end)
        if not self.goes_through and not self.base.differs_only_in_names(self.inputs.latest):
            raise CommandsCame
        return end

    def _named(self, fold: LiveFold, last: Event | None) -> MapInputs:
        """The inputs of the map, with names recorded meanwhile."""
        latest = self.inputs.latest
        if last is None or not self.base.differs_only_in_names(latest):
            return self.base
        fold.use_names(last.offset, latest.corrections)
        return latest

    def _shadow_of(self) -> ShadowOf:
        def shadow_of(sink: DatabaseSink) -> Shadow[Connection]:
            if self._keeps(sink.name):
                return KeptVectors(sink, self.found[sink.name].next_offset)
            return sink.shadow()

        return shadow_of

    def _keeps(self, sink: SinkName) -> bool:
        """Whether the new map has the same rows of this sink.

        Parked events are tried again, and one that can be folded now would move all later rows.
        """
        found = self.found[sink]
        return SINKS[sink].is_kept and found.observed == self.base.observed and not self.parked

    def _swaps_indexed_vectors(self) -> bool:
        return any(
            has_hnsw(store.connection)
            for store in self.stores
            for sink in store.sinks
            if sink.name == "vectors" and not self._keeps("vectors")
        )


def refuse_if_not_allowed(stores: Sequence[Store], advice: str) -> None:
    """Raise DatabaseError when this role may not make the tables of a refold."""
    for store in stores:
        with database_errors(store.url):
            row = store.connection.execute(statements("checkpoint")["may_create"]).fetchone()
        if row is None or not row[0]:
            raise DatabaseError(
                f"{store.place}: the log has commands that the map there does not know yet, and"
                " this role may not make the tables of a new one; have their owner make it, then"
                f" start again; {advice}"
            )


class KeptVectors:
    """Implements `Shadow` for vectors that have the events before ``start``, without a shadow.

    Rows of later events are added to the readers' table, in the transaction of the swap.
    """

    def __init__(self, sink: DatabaseSink, start: Offset) -> None:
        self._sink: Final = sink
        self._start: Final = start

    def create(self, connection: Connection) -> None:
        """Nothing to do."""

    def load(self, changes: BatchChanges, view: MapView) -> Callable[[Connection], None]:
        """Returns a function that adds the rows of events that came since."""
        missing = [row for row in changes.embedded if row[0].offset >= self._start]
        if not missing:
            return lambda _: None
        return self._sink.prepare(replace(changes, embedded=missing), view).send

    def finish(self, view: MapView) -> Callable[[Connection], Mapping[str, int]]:
        """Returns a function that compares numbers."""
        expected = sum(o.embedding_crc is not None for o in view.observations)

        def finish(connection: Connection) -> Mapping[str, int]:
            found = count_vectors(connection, READERS)
            if found != expected:
                raise DatabaseError(
                    f"{describe_connection(connection)}: {TABLE} has {found:,} rows, the map"
                    f" {expected:,} searchable detections; run `{advised('replay')}`, which makes"
                    " both again"
                )
            return {TABLE: found}

        return finish

    def lock_readers(self, connection: Connection) -> None:
        """Nothing to do: readers see the added rows when the transaction is committed."""

    def swap_in(self, connection: Connection) -> None:
        """Nothing to do."""
