"""The port between the fold and what the map is written to.

A sink that follows a log implements `LiveSink`. For each batch of events the runner (`tail`) calls
`prepare` with what the batch changed and the view, opens a transaction, calls what `prepare`
returned, moves the sink's checkpoint and commits: rows and checkpoint are written together or not
at all. After a lost connection it calls `ensure` and, if the batch was not committed, the same
prepared write again.

A sink that can also be rebuilt from the start of a log implements `RebuildSink`; a sink of the
databases (`stores.DatabaseSink`) does both. The runner (`rebuild`) calls, in this order:

1. `RebuildSink.drop_leftovers`, outside a transaction; then it opens the one transaction of 2 to 5
2. `Shadow.create`
3. while the log is folded: `Shadow.load`, several times; at its end: `Shadow.finish`
4. `Shadow.lock_readers`, for all shadows before any is swapped in, and again until all got theirs
5. `Shadow.swap_in`; it replaces the checkpoint and commits. Readers see the old map until then
6. `RebuildSink.drop_replaced`, outside a transaction

``Tx`` is what an open transaction of the sink's store is: a psycopg connection for the databases,
`memory_sink.MemoryTables` for memory. Methods that take the view take no transaction, so that the
fold can go on while a thread sends what they returned.

The runner writes only what the view has, and each event's changes once. Ordinals are ascending in
`BatchChanges` and the same in every fold of a log: made into ids they give the same rows by tail
and by rebuild, and no write has to look anything up.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, Literal, Protocol, TypeAlias, TypeVar

from eventsrc.envelope import Offset
from projections.model.changes import BatchChanges
from projections.model.view import MapView

SinkName: TypeAlias = Literal["graph", "vectors"]
"""Under which checkpoints and locks in the databases know a sink."""
Tx = TypeVar("Tx", contravariant=True)


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """How far a sink is, and what it was made from.

    ``next_offset`` events of the log ``log_id`` are in, folded with ``settings`` (canonical JSON;
    ``fingerprint`` is their hash). ``last_event`` is `event_hash` of the last of them, "" for none:
    it tells a log that was cut and continued differently. ``digest`` is the map's, when known.
    """

    log_id: str
    fingerprint: str
    settings: str
    next_offset: Offset
    last_event: str
    digest: str | None = None


@dataclass(frozen=True, slots=True)
class PreparedWrite(Generic[Tx]):
    """The rows of a batch. ``send`` writes them, again if the first transaction failed.

    ``is_small`` says that ``send`` executes plain statements only, no COPY: a database can then
    take them in one round trip (a pipeline).
    """

    send: Callable[[Tx], None]
    is_small: bool


class LiveSink(Protocol[Tx]):
    """Rows that follow the log."""

    def ensure(self, transaction: Tx) -> bool:
        """Create what is written to if it is missing; True then.

        Raises DatabaseError when something has its name that mapfold did not make.
        """

    def prepare(self, changes: BatchChanges, view: MapView) -> PreparedWrite[Tx]:
        """Rows to insert, update and delete after ``changes``, as ``view`` has them now."""


class Shadow(Protocol[Tx]):
    """New rows beside those that readers see. It is made for one rebuild, which may fail."""

    def create(self, transaction: Tx) -> None:
        """Create it, empty."""

    def load(self, changes: BatchChanges, view: MapView) -> Callable[[Tx], None]:
        """What adds the rows of new keyframes and observations that never change again."""

    def finish(self, view: MapView) -> Callable[[Tx], Mapping[str, int]]:
        """What adds all other rows, builds indexes and returns how many rows each table has.

        That raises DatabaseError when the view has other numbers.
        """

    def lock_readers(self, transaction: Tx) -> None:
        """Lock what `swap_in` replaces against readers, until the transaction ends."""

    def swap_in(self, transaction: Tx) -> None:
        """Put the shadow in the place of what readers see."""


class RebuildSink(Protocol[Tx]):
    """Rows that can be made anew while readers use the old ones."""

    def drop_leftovers(self, transaction: Tx) -> None:
        """Drop what an earlier rebuild replaced or left. Raises DatabaseError like `ensure`."""

    def shadow(self) -> Shadow[Tx]:
        """A shadow, not created yet."""

    def drop_replaced(self, transaction: Tx) -> None:
        """Have what was replaced dropped, now or once its last reader is gone.

        It may close the connection and leave the server at work.
        """
