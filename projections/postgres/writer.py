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
"""

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

from projections.fold.errors import (
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
"""Errors after which another attempt may succeed. EmbeddedServerError is raised for a server killed
during its start."""
FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0

OnTrouble: TypeAlias = Callable[[str], None]


@dataclass(slots=True)
class Backoff:
    """Growing pauses during one outage. Gives up after ``patience_s``, never for None."""

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
        """Report a failed attempt and double the next pause. Raises it after ``patience_s``."""
        self.waited_s += self.pause_s
        if self.patience_s is not None and self.waited_s > self.patience_s:
            raise error
        self.trouble(str(error))
        self.pause_s = min(self.pause_s * 2, LONGEST_PAUSE_S)


FoundCheckpoints: TypeAlias = dict[SinkName, Checkpoint | None]
"""The checkpoints of a store's sinks; None where there is none."""


class LostCommits(Exception):
    """The server lost commits: fold again from its checkpoint."""


@dataclass(frozen=True, slots=True)
class SinkBatch:
    """The write to one sink in one transaction, and its checkpoint before and after."""

    sink: DatabaseSink
    write: PreparedWrite[Connection]
    letters: tuple[DeadLetter, ...]
    before: Checkpoint
    after: Checkpoint


@dataclass(slots=True)
class Writer:
    """Writes to one store. ``revive`` restarts the embedded server; ``trouble`` gets messages.

    ``checkpoints`` are the sinks' last known ones; the caller of `write` updates them. Gives up
    after ``patience_s`` without a connection, never for None.
    """

    store: Store
    checkpoints: dict[SinkName, Checkpoint]
    revive: Callable[[], None]
    stop: threading.Event
    trouble: OnTrouble
    patience_s: float | None = None

    def write(self, batch: list[SinkBatch]) -> list[Checkpoint]:
        """Commit a batch; returns the new checkpoints, in its order."""
        while True:
            try:
                with database_errors(self.store.url):
                    return self._transaction(batch)
            except DatabaseUnavailable as error:
                self.trouble(str(error))
            found = self._reconnect()
            if not self._unchanged(found):
                return self._committed(batch, found)

    def write_heartbeat(self) -> None:
        """Record that the tail is alive; a lost connection is made again.

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
        # A pipeline takes two round trips instead of twenty, which is most of the delay of a live
        # tail. COPY cannot be part of one.
        is_small = all(part.write.is_small for part in batch)
        with (
            connection.pipeline() if is_small else contextlib.nullcontext(),
            connection.transaction(),
        ):
            for part in batch:
                part.write.send(connection)
                for letter in part.letters:
                    checkpoints.park(connection, part.sink.name, letter)
            return [
                checkpoints.advance(connection, part.sink.name, part.before, part.after)
                for part in batch
            ]

    def _reconnect(self) -> FoundCheckpoints:
        """Make a new connection; returns the checkpoints there."""
        backoff = Backoff(self.store.place, self.stop, self.trouble, self.patience_s)
        while True:
            backoff.wait()
            try:
                self.revive()
                self.store.reconnect()
                return self._read_checkpoints()
            except AWAY as error:
                backoff.failed(error)

    def _read_checkpoints(self) -> FoundCheckpoints:
        connection, found = self.store.connection, FoundCheckpoints()
        with database_errors(self.store.url), connection.transaction():
            for sink in self.store.sinks:
                # A transaction that was rolled back may have changed the sink's state.
                if sink.ensure(connection):
                    raise LostCommits  # all rows are gone; the next pass reports why
                found[sink.name] = checkpoints.load(connection, sink.name)
        return found

    def _unchanged(self, found: FoundCheckpoints) -> bool:
        return all(_is_same(found[s.name], self.checkpoints[s.name]) for s in self.store.sinks)

    def _committed(self, batch: list[SinkBatch], found: FoundCheckpoints) -> list[Checkpoint]:
        """The checkpoints of a batch that was committed, in its order."""
        ends = {part.sink.name: part.after.next_offset for part in batch}
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


def _is_same(found: Checkpoint | None, ours: Checkpoint) -> bool:
    """Whether they are equal but for the digest, which only a rebuild writes."""
    return found is not None and replace(found, digest=ours.digest) == ours
