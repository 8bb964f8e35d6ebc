"""The interface (port) between the fold and the places to which the map is written.

Each implements `Sink`. For each batch of events that a tail follows, `batch_writer` calls `prepare`
with the ids that the batch changed and the view, opens a transaction, calls ``send`` of the
prepared write, moves the sink's checkpoint and commits: both are written or none. After a lost
connection it calls `ensure` and, if the batch was not committed, the same ``send`` again.

For a rebuild from the start of a log `shadows` calls, in this order:

1. `Sink.drop_leftovers`, outside a transaction; then it opens the one transaction of 2 to 5
2. `Shadow.create`
3. while the log is folded: `Shadow.load`, several times; at its end: `Shadow.finish`
4. `Shadow.lock_readers`, for all shadows before any is swapped in; again for all if one fails
5. `Shadow.swap_in`; then it commits, with a new checkpoint. Readers see the old map until then
6. `Sink.drop_replaced`, outside a transaction

``Conn`` is what the sink writes through: a psycopg connection, or in tests dictionaries in memory.
It is in a transaction, except in steps 1 and 6. A method that gets the view gets no connection: it
returns a function that gets one, so that the fold can go on while a thread calls that function.

Each event's changes reach a sink once. Ordinals are the same in every fold of a log: a sink that
computes its ids from them has the same rows after a tail and a rebuild, and never looks an id up.
`labels.SINKS` is the table of the sinks of the databases; `stores` makes them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from eventsrc.envelope.model import Offset
from projections.map.changes import BatchChanges
from projections.map.view import MapView

Conn = TypeVar("Conn", contravariant=True)


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A sink's position in the log, and its origin.

    ``next_offset`` events of the log ``log_id`` are in, folded with ``settings`` (canonical JSON)
    under the corrections of the commands before ``known_at``; ``fingerprint`` is of both.
    ``last_event`` is `event_hash` of the last event, "" for none: it detects a log that was cut and
    continued differently. ``digest`` is the map's, when known. ``observed`` is as in
    `inputs.MapInputs`. ``maps`` identifies the occupancy maps, None for none.
    """

    log_id: str
    fingerprint: str
    settings: str
    next_offset: Offset
    last_event: str
    digest: str | None
    known_at: Offset
    observed: str
    maps: str | None = None


@dataclass(frozen=True, slots=True)
class PreparedWrite(Generic[Conn]):
    """The rows of a batch. ``send`` writes them, again if the first transaction failed.

    ``is_small`` says that ``send`` executes plain statements only, no COPY: a database can then
    take them in one round trip (a pipeline).
    """

    send: Callable[[Conn], None]
    is_small: bool


class Shadow(Protocol[Conn]):
    """The new rows of one rebuild, beside those that readers see."""

    def create(self, connection: Conn) -> None:
        """Create it, empty."""

    def load(self, changes: BatchChanges, view: MapView) -> Callable[[Conn], None]:
        """Returns a function that inserts rows of new keyframes and observations, those rows that
        never change again."""

    def finish(self, view: MapView) -> Callable[[Conn], Mapping[str, int]]:
        """Returns a function that inserts all other rows, builds indexes and counts rows by table.

        The function raises DatabaseError when the view has other numbers.
        """

    def lock_readers(self, connection: Conn) -> None:
        """Lock what `swap_in` replaces against readers, until the transaction ends."""

    def swap_in(self, connection: Conn) -> None:
        """Put the shadow in the place of what readers see."""


class Sink(Protocol[Conn]):
    """Rows that follow a log, and that can be rebuilt while readers use the old ones."""

    def ensure(self, connection: Conn) -> bool:
        """Create what rows are written to, if it is missing; returns whether it was.

        Raises DatabaseError when something that mapfold did not make has its name.
        """

    def prepare(self, changes: BatchChanges, view: MapView) -> PreparedWrite[Conn]:
        """The write that brings the rows up to date with ``view`` after a batch's ``changes``."""

    def drop_leftovers(self, connection: Conn) -> None:
        """Drop tables that an earlier rebuild replaced or left behind. Raises DatabaseError like
        `ensure`."""

    def shadow(self) -> Shadow[Conn]:
        """A shadow, not created yet."""

    def drop_replaced(self, connection: Conn) -> None:
        """Drop the replaced tables, now or once their last reader has ended.

        May close the connection while the server still drops.
        """
