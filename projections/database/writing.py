"""Writing batches so that each is in exactly once, whatever the server does meanwhile.

Rows and checkpoint move in one transaction, the checkpoint by compare-and-set. When a transaction
fails because the server or the connection did, nobody knows at first whether it was committed. So
the batch is kept, the connection is made anew (with growing pauses), and the checkpoint is asked:

* it stands where the batch begins: the batch was not committed; write it again
* it stands where the batch ends: it was committed, only the answer was lost; go on
* it stands before: the server lost commits it had not yet flushed (``synchronous_commit = off``);
  the rows went with it, so fold again from there (`LostCommits`)
* anything else: somebody else writes; stop (CheckpointMoved)

A heartbeat that finds the connection lost is a batch of nothing: the same is asked after it, of
every sink of the store, so that no commit that was lost while nothing came goes unnoticed.

Pauses between attempts to reach a database that is away.
"""

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

from eventsrc.envelope import Offset
from projections.errors import (
    CheckpointMoved,
    DatabaseError,
    DatabaseUnavailable,
    EmbeddedServerError,
)

from . import checkpoints
from .checkpoints import DeadLetter
from .connection import Connection, database_errors
from .sink import Checkpoint, PreparedWrite, SinkName
from .stores import DatabaseSink, Store

AWAY: Final = (DatabaseUnavailable, EmbeddedServerError)
"""What another attempt may mend: a server killed once more while it starts does not start."""
FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0

OnTrouble: TypeAlias = Callable[[str], None]


@dataclass(slots=True)
class Backoff:
    """One outage. Gives up after ``patience_s`` without a connection; None never does."""

    place: str
    stop: threading.Event
    trouble: OnTrouble
    patience_s: float | None = None
    pause_s: float = FIRST_PAUSE_S
    waited_s: float = 0.0

    def wait(self) -> None:
        """Wait before the next attempt. Raises DatabaseUnavailable when stopped meanwhile."""
        if self.stop.wait(self.pause_s):
            raise DatabaseUnavailable(
                f"{self.place}: stopped while the database was away; what was not written yet is in"
                " the log and comes with the next start"
            )

    def failed(self, error: DatabaseError) -> None:
        """An attempt failed: tell of it and wait longer next time. Raises it out of patience."""
        self.waited_s += self.pause_s
        if self.patience_s is not None and self.waited_s > self.patience_s:
            raise error
        self.trouble(str(error))
        self.pause_s = min(self.pause_s * 2, LONGEST_PAUSE_S)


Found: TypeAlias = dict[SinkName, Checkpoint | None]
"""The checkpoints of a store's sinks; None where there is none."""


class LostCommits(Exception):
    """The database is behind what was written to it: fold again from its checkpoint."""


@dataclass(frozen=True, slots=True)
class SinkBatch:
    """What one sink gets in one transaction, and the checkpoints before and after it."""

    sink: DatabaseSink
    write: PreparedWrite[Connection]
    letters: tuple[DeadLetter, ...]
    before: Checkpoint
    next_offset: Offset
    last_event: str


@dataclass(slots=True)
class Writer:
    """Writes to one store. ``revive`` restarts a server that is ours; ``trouble`` is told of it.

    ``checkpoints`` are where the sinks stand as far as we know; who calls `write` moves them.
    Gives up after ``patience_s`` without a connection; None never does.
    """

    store: Store
    checkpoints: dict[SinkName, Checkpoint]
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
            found = self._reconnect()
            if not self._unchanged(found):
                return self._committed(batch, found)

    def beat(self) -> None:
        """Say that the tail lives; a lost connection is made again.

        Raises LostCommits when the server came back without what it had committed.
        """
        while True:
            try:
                with database_errors(self.store.url):
                    for sink in self.store.sinks:
                        checkpoints.write_heartbeat(self.store.connection, sink.name)
                    return
            except DatabaseUnavailable as error:
                self.trouble(str(error))
            found = self._reconnect()
            if not self._unchanged(found):
                self._committed([], found)

    def _transaction(self, batch: list[SinkBatch]) -> list[Checkpoint]:
        connection = self.store.connection
        # Few rows: all statements go out at once, two round trips in all instead of twenty, which
        # is what the delay of a live tail is made of. COPY cannot be part of a pipeline.
        few = all(part.write.is_small for part in batch)
        with connection.pipeline() if few else contextlib.nullcontext(), connection.transaction():
            for part in batch:
                part.write.send(connection)
                for letter in part.letters:
                    checkpoints.park(connection, part.sink.name, letter)
            return [
                checkpoints.advance(
                    connection, part.sink.name, part.before, part.next_offset, part.last_event
                )
                for part in batch
            ]

    def _reconnect(self) -> Found:
        """A new connection, and what the checkpoints are there."""
        backoff = Backoff(self.store.place, self.stop, self.trouble, self.patience_s)
        while True:
            backoff.wait()
            try:
                self.revive()
                self.store.reconnect()
                return self._look()
            except AWAY as error:
                backoff.failed(error)

    def _look(self) -> Found:
        connection, found = self.store.connection, Found()
        with database_errors(self.store.url), connection.transaction():
            for sink in self.store.sinks:
                # What a rolled back transaction had made is not there, whatever the sink thinks.
                if sink.ensure(connection):
                    raise LostCommits  # all the rows are gone; the next pass finds out why
                found[sink.name] = checkpoints.load(connection, sink.name)
        return found

    def _unchanged(self, found: Found) -> bool:
        return all(_same(found[s.name], self.checkpoints[s.name]) for s in self.store.sinks)

    def _committed(self, batch: list[SinkBatch], found: Found) -> list[Checkpoint]:
        """The checkpoints of a batch that is in, in its order."""
        ends = {part.sink.name: part.next_offset for part in batch}
        for sink in self.store.sinks:
            before, now = self.checkpoints[sink.name], found[sink.name]
            if now is None or now.next_offset < before.next_offset:
                raise LostCommits
            if now.next_offset != ends.get(sink.name, before.next_offset):
                raise CheckpointMoved(
                    f"{self.store.place}: after the connection was lost the checkpoint of the"
                    f" {sink.name} is at {now.next_offset:,}, which this tail never wrote:"
                    " something else writes there; stop it, then start again"
                )
        return [now for part in batch if (now := found[part.sink.name]) is not None]


def _same(found: Checkpoint | None, ours: Checkpoint) -> bool:
    """Whether a checkpoint is ours; only a rebuild notes the digest, and it changes nothing."""
    return found is not None and replace(found, digest=ours.digest) == ours
