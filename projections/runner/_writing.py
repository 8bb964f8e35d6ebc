"""Writing batches so that each is in exactly once, whatever the server does meanwhile.

Rows and checkpoint move in one transaction, the checkpoint by compare-and-set. When a transaction
fails because the server or the connection did, nobody knows at first whether it was committed. So
the batch is kept, the connection is made anew (with growing pauses), and the checkpoint is asked:

* it stands where the batch begins: the batch was not committed; write it again
* it stands where the batch ends: it was committed, only the answer was lost; go on
* it stands before: the server lost commits it had not yet flushed (``synchronous_commit = off``);
  the rows went with it, so fold again from there (`LostCommits`)
* anything else: somebody else writes; stop (CheckpointMoved)
"""

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

from projections.errors import CheckpointMoved, DatabaseUnavailable
from projections.postgres.connect import database_errors
from projections.sink import Checkpoint, Sink
from projections.sinks import _checkpoint
from projections.sinks._checkpoint import DeadLetter

from ._stores import Store

FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0


class LostCommits(Exception):
    """The database is behind what was written to it: fold again from its checkpoint."""


@dataclass(frozen=True, slots=True)
class SinkBatch:
    """What one sink gets in one transaction, and the checkpoints before and after it."""

    sink: Sink[Any]
    changes: Any
    letters: tuple[DeadLetter, ...]
    before: Checkpoint
    next_offset: int
    last_event: str


OnTrouble: TypeAlias = Callable[[str], None]


@dataclass(slots=True)
class Writer:
    """Writes to one store. ``revive`` restarts a server that is ours; ``trouble`` is told of it.

    Gives up after ``patience_s`` without a connection; None never does.
    """

    store: Store
    revive: Callable[[], None]
    stop: threading.Event
    trouble: OnTrouble
    patience_s: float | None = None

    def write(self, batch: list[SinkBatch]) -> list[Checkpoint]:
        """Commit a batch; the new checkpoints, in its order."""
        while True:
            try:
                with database_errors(self.store.url):
                    return self._transaction(batch)
            except DatabaseUnavailable as error:
                self.trouble(str(error))
            self._reconnect()
            committed = self._committed(batch)
            if committed is not None:
                return committed

    def beat(self, sinks: list[Sink[Any]]) -> None:
        """Say that the tail lives; a lost connection is made again."""
        try:
            with database_errors(self.store.url):
                for sink in sinks:
                    _checkpoint.beat(self.store.connection, sink.name)
        except DatabaseUnavailable as error:
            self.trouble(str(error))
            self._reconnect()

    def _transaction(self, batch: list[SinkBatch]) -> list[Checkpoint]:
        connection = self.store.connection
        # Few rows: all statements go out at once, two round trips in all instead of twenty, which
        # is what the delay of a live tail is made of. COPY cannot be part of a pipeline.
        few = all(part.sink.few(part.changes) for part in batch)
        with connection.pipeline() if few else contextlib.nullcontext(), connection.transaction():
            for part in batch:
                part.sink.write(connection, part.changes)
                for letter in part.letters:
                    _checkpoint.park(connection, part.sink.name, letter)
            return [
                _checkpoint.advance(
                    connection, part.sink.name, part.before, part.next_offset, part.last_event
                )
                for part in batch
            ]

    def _reconnect(self) -> None:
        pause, waited = FIRST_PAUSE_S, 0.0
        while True:
            if self.stop.wait(pause):
                raise DatabaseUnavailable(
                    f"{self.store.place}: stopped while the database was away; what was not"
                    " written yet is in the log and comes with the next start"
                )
            try:
                self.revive()
                self.store.reconnect()
                # What a rolled back transaction had made is not there, whatever the sinks think.
                with database_errors(self.store.url), self.store.connection.transaction():
                    for sink in self.store.sinks:
                        sink.ensure(self.store.connection)
            except DatabaseUnavailable as error:
                waited += pause
                if self.patience_s is not None and waited > self.patience_s:
                    raise
                self.trouble(str(error))
                pause = min(pause * 2, LONGEST_PAUSE_S)
            else:
                return

    def _committed(self, batch: list[SinkBatch]) -> list[Checkpoint] | None:
        """The checkpoints if the batch is in, None if it has to be written again."""
        with database_errors(self.store.url):
            found = [_checkpoint.load(self.store.connection, part.sink.name) for part in batch]
        if all(f == part.before for f, part in zip(found, batch, strict=True)):
            return None
        for checkpoint, part in zip(found, batch, strict=True):
            if checkpoint is None or checkpoint.next_offset < part.before.next_offset:
                raise LostCommits
            if checkpoint.next_offset != part.next_offset:
                raise CheckpointMoved(
                    f"{self.store.place}: after the connection was lost the checkpoint of the"
                    f" {part.sink.name} is at {checkpoint.next_offset}, which this tail never"
                    " wrote: something else writes there; stop it, then start again"
                )
        return [checkpoint for checkpoint in found if checkpoint is not None]
