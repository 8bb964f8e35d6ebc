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
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from eventsrc.envelope.model import Offset
from projections.fold.map_errors import (
    CheckpointMoved,
    DatabaseError,
    DatabaseUnavailable,
    EmbeddedServerError,
)
from projections.map.changes import BatchChanges
from projections.map.view import MapView

from . import checkpoints
from .checkpoints import DeadLetter
from .connection import Connection, database_errors
from .labels import SinkName
from .sink import Checkpoint, PreparedWrite
from .stores import Store
from .tail_progress import TailPlan

AWAY: Final = (DatabaseUnavailable, EmbeddedServerError)
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
            raise DatabaseUnavailable(
                f"{self.place}: stopped while the database was away; what was not written yet is in"
                " the log and comes with the next start"
            )

    def failed(self, error: DatabaseError) -> None:
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
            except DatabaseUnavailable as error:
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
                raise CheckpointMoved(
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
