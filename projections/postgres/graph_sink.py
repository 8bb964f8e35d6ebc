"""The sink that writes the map as an Apache AGE graph."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final

from psycopg import sql

from projections.fold.errors import DatabaseError
from projections.map.changes import BatchChanges
from projections.map.view import MapView

from . import graph_schema, map_table
from .connection import Connection, describe_connection, ensure_extension
from .cypher import policies_apply
from .grants import copy_privileges
from .graph_rows import GraphRows, changed_rows, changing_rows, fixed_rows
from .labels import (
    COUNT_KEYS,
    EDGE_LABELS,
    GRAPH,
    LABELS,
    MAP_TABLE,
    NEXT_GRAPH,
    OLD_GRAPH,
    VERTEX_LABELS,
    Label,
)
from .loader import InsertLoader, Load, Loader, LoaderName, loader_of, unnest_columns
from .map_rows import MapRow, map_rows
from .replaced_tables import try_drop_lock, wait_for_drop, wait_for_earlier_transactions
from .sink import PreparedWrite, SinkName
from .statements import statements

EARLY: Final[frozenset[Label]] = frozenset({"Observation"})
"""Labels that a rebuild indexes before it writes them. That costs the server more than indexing
afterwards, but the server has the time while the fold goes on."""
LATE: Final = frozenset(LABELS) - EARLY
SMALL_BATCH: Final = 200
"""Below this many rows an INSERT, sent down the pipeline, beats COPY's extra round trips."""


class GraphSink:
    """Implements `LiveSink` and `RebuildSink` for the graph ``semantic_map``."""

    name: Final[SinkName] = "graph"

    def __init__(self, loader: LoaderName = "copy") -> None:
        self._loader: Loader = loader_of(loader)

    def ensure(self, connection: Connection) -> bool:
        """Create an empty graph if there is none, or one without labels. Raises ProjectionMismatch
        for that of an older version."""
        ensure_extension(connection, "age")
        graph_schema.adopt_if_empty(connection, GRAPH)
        if not graph_schema.exists(connection, GRAPH):
            graph_schema.create(connection, GRAPH)
        elif graph_schema.is_bare(connection, GRAPH):
            graph_schema.add_labels(connection, GRAPH)
        else:
            graph_schema.refuse_older(connection, GRAPH)
            map_table.refuse_missing(connection)
            return False
        graph_schema.index(connection, GRAPH)
        map_table.ensure(connection)
        map_table.replace(connection, [])
        return True

    def prepare(self, changes: BatchChanges, view: MapView) -> PreparedWrite[Connection]:
        """Rows that a batch changed."""
        rows = changed_rows(changes, view)
        maps = map_rows(view) if changes.maps else None
        is_small = maps is None and sum(map(len, rows.inserted.values())) < SMALL_BATCH
        return PreparedWrite(partial(self._write, rows, maps, is_small), is_small)

    def _write(
        self,
        rows: GraphRows,
        maps: list[MapRow] | None,
        is_small: bool,
        connection: Connection,
    ) -> None:
        copies = not is_small and not policies_apply(connection)
        loader = self._loader if copies else InsertLoader()
        for label, inserted in rows.inserted.items():
            _new_rows(loader, GRAPH, label, inserted)(connection)
        for label, upserted in rows.upserted.items():
            kind = "upsert_vertex" if label in VERTEX_LABELS else "upsert_edge"
            unnest_columns(kind, GRAPH, label, upserted)(connection)
        for label, replaced in rows.replaced.items():
            _delete(connection, label, [row[1] for row in replaced], "delete_from")
            _new_rows(InsertLoader(), GRAPH, label, replaced)(connection)
        for label, ids in rows.deleted.items():
            _delete(connection, label, ids)
        if maps is not None:
            map_table.replace(connection, maps)

    def drop_leftovers(self, connection: Connection) -> None:
        """Drop a replaced graph that a reader held on to; refuse a graph that is not ours, unless
        it is empty.

        Not inside the rebuild's transaction: AGE 1.5 crashes the session that drops a graph after
        it has made another one in the same transaction.
        """
        ensure_extension(connection, "age")
        with connection.transaction():
            graph_schema.adopt_if_empty(connection, GRAPH)
            graph_schema.exists(connection, GRAPH)
        if try_drop_lock(connection, self.name):
            for graph in (OLD_GRAPH, NEXT_GRAPH):
                with connection.transaction():
                    graph_schema.drop(connection, graph)

    def shadow(self) -> "GraphShadow":
        """A shadow, not created yet."""
        return GraphShadow(self._loader)

    def drop_replaced(self, connection: Connection) -> None:
        """Drop the replaced graph once its last reader has ended."""
        if wait_for_earlier_transactions(connection) and try_drop_lock(connection, self.name):
            graph_schema.drop_in_background(connection, OLD_GRAPH)


class GraphShadow:
    """Implements `Shadow`: the graph ``semantic_map_next``."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create(self, connection: Connection) -> None:
        """Create an empty graph and its early indexes."""
        graph_schema.create(connection, NEXT_GRAPH)
        graph_schema.index(connection, NEXT_GRAPH, EARLY)

    def load(self, changes: BatchChanges, view: MapView) -> Load:
        """Returns a function that writes the fixed rows of new keyframes and observations."""
        return self._load(fixed_rows(view, changes.keyframes, changes.observations))

    def finish(self, view: MapView) -> Callable[[Connection], Mapping[str, int]]:
        """Returns a function that writes the changing rows, builds the other indexes and compares
        numbers by label."""
        load, counts = self._load(changing_rows(view)), view.counts()
        expected = {label: counts[COUNT_KEYS[label]] for label in LABELS}
        maps = map_rows(view)

        def finish(connection: Connection) -> Mapping[str, int]:
            load(connection)
            map_table.ensure(connection)
            map_table.replace(connection, maps)
            graph_schema.index(connection, NEXT_GRAPH, LATE)
            graph_schema.analyze(connection, NEXT_GRAPH)
            found = _compared(connection, expected)
            return {**found, MAP_TABLE: len(maps)} if maps else found

        return finish

    def lock_readers(self, connection: Connection) -> None:
        """Keep readers away from the graph."""
        wait_for_drop(connection, GraphSink.name)
        graph_schema.lock(connection, GRAPH)

    def swap_in(self, connection: Connection) -> None:
        """Put the shadow in the readers' place, open to the same roles."""
        copy_privileges(connection, GRAPH, NEXT_GRAPH)
        graph_schema.swap_in(connection, NEXT_GRAPH)

    def _load(self, rows_of: Mapping[Label, list[Any]]) -> Load:
        loads = [
            _new_rows(self._loader, NEXT_GRAPH, label, rows) for label, rows in rows_of.items()
        ]

        def load(connection: Connection) -> None:
            for send in loads:
                send(connection)

        return load


def _delete(
    connection: Connection, label: Label, ids: Sequence[int], statement: str = "delete"
) -> None:
    query = statements("graph")[statement].format(
        graph=sql.Identifier(GRAPH), label=sql.Identifier(label)
    )
    connection.execute(query, [[str(i) for i in ids]])


def _new_rows(loader: Loader, graph: str, label: Label, rows: list[Any]) -> Load:
    if label in EDGE_LABELS:
        return loader.edges(graph, label, rows)
    return loader.vertices(graph, label, rows)  # type: ignore[arg-type]


def _compared(connection: Connection, expected: Mapping[Label, int]) -> Mapping[str, int]:
    found = graph_schema.counts(connection, NEXT_GRAPH)
    wrong = [
        f"{label}: {found[label]} rows, {expected[label]} in the map"
        for label in LABELS
        if found[label] != expected[label]
    ]
    if wrong:
        raise DatabaseError(
            f"{describe_connection(connection)}: the rebuilt graph does not match the map"
            f" ({'; '.join(wrong)}); the old one stays, please report this"
        )
    return found
