"""Vectors that a refold keeps: corrections of places and Objects change none of their rows."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

from eventsrc.envelope import Offset
from projections.errors import DatabaseError
from projections.model.changes import BatchChanges
from projections.model.view import MapView

from . import vector_table
from .connection import Connection, describe_connection
from .labels import TABLE
from .stores import DatabaseSink
from .vector_table import READERS


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
            found = vector_table.count(connection, READERS)
            if found != expected:
                raise DatabaseError(
                    f"{describe_connection(connection)}: {TABLE} has {found:,} rows, the map"
                    f" {expected:,} searchable detections; run mapfold replay, which makes both"
                    " anew"
                )
            return {TABLE: found}

        return finish

    def lock_readers(self, connection: Connection) -> None:
        """Nothing to do: readers see the added rows when the transaction is committed."""

    def swap_in(self, connection: Connection) -> None:
        """Nothing to do."""
