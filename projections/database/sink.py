"""The port between the fold and whatever its deltas are written to.

A sink first only *notes* deltas; nothing is written until the runner *takes* what has changed and
*writes* it inside a transaction that also moves the sink's checkpoint. What was taken is a value of
its own, so a write that failed can be repeated with it, and writing it again does no harm.

A rebuild goes another way to the same rows: `begin` a shadow; while the fold runs `take_final` the
rows that can never change again and `load` them; then `take_rest` and `load` the rest, `index`,
`check` and `swap` the shadow in, all in one transaction; then `tidy` away what it replaced. Until
then nobody sees anything of it. What needs the view and what needs the connection are apart, so
that a thread can send while the fold goes on.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, TypeVar

from eventsrc.envelope import Offset
from projections.deltas import Delta
from projections.model.view import MapView

from .connection import Connection

SinkName: TypeAlias = Literal["graph", "vectors"]
Changes = TypeVar("Changes")


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


class Sink(Protocol[Changes]):
    """A place the map is written to. ``connection`` is inside a transaction of the runner's."""

    @property
    def name(self) -> SinkName:
        """Under which the checkpoint and the locks know it."""

    @property
    def rebuilds_from_view(self) -> bool:
        """True when a rebuild need not `note`: all that it will write is in the view."""

    def note(self, deltas: Sequence[Delta], logged_ns: int, view: MapView) -> None:
        """Remember what an event's deltas change; ``view`` has not applied them yet."""

    def take(self, view: MapView) -> Changes:
        """What changed since the last take, as ``view`` has it now."""

    def ensure(self, connection: Connection) -> bool:
        """Create what `write` needs, if it is missing: True then. Refuses what is not ours."""

    def few(self, changes: Changes) -> bool:
        """True when `write` will send plain statements only, so that they may be pipelined."""

    def write(self, connection: Connection, changes: Changes) -> None:
        """Write what was taken."""

    def clear(self, connection: Connection) -> None:
        """Before a rebuild's transaction (autocommit): remove what an earlier one left behind."""

    def begin(self, connection: Connection) -> None:
        """Create an empty shadow."""

    def take_final(self, view: MapView) -> Changes | None:
        """Rows that can never change again, taken out if enough of them wait; else None."""

    def take_rest(self, view: MapView) -> Changes:
        """All rows that `take_final` has not given out yet; the fold is over."""

    def load(self, changes: Changes) -> Callable[[Connection], None]:
        """What writes what was taken to the shadow, and has only to send it."""

    def index(self, connection: Connection) -> None:
        """Index the shadow, which is complete now, and gather its statistics."""

    def check(self, connection: Connection, view: MapView) -> Mapping[str, int]:
        """Rows of the shadow, by label or table. Raises DatabaseError if the view has others."""

    def lock(self, connection: Connection) -> None:
        """Keep readers away from what `swap` replaces, until the transaction ends."""

    def swap(self, connection: Connection) -> None:
        """Put the shadow in the place of what readers see."""

    def tidy(self, connection: Connection) -> None:
        """After the commit (autocommit): have what was replaced removed. Nobody need wait for it;
        ``connection`` may be closed and its session be at work for a while."""
