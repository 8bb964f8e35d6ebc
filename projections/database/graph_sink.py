"""The sink that writes the map as an Apache AGE graph."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from psycopg import sql

from projections.deltas import Delta
from projections.errors import DatabaseError
from projections.model.view import MapView

from . import graph_schema as _graph_ddl
from . import swap
from .connection import Connection, describe_connection, ensure_extension
from .cypher import policies_apply
from .grants import copy_privileges
from .graph_rows import GraphChanges, GraphRows, WholeGraph
from .labels import (
    COUNT_KEYS,
    EDGE_LABELS,
    GRAPH,
    LABELS,
    NEXT_GRAPH,
    OLD_GRAPH,
    VERTEX_LABELS,
    Label,
)
from .loader import InsertLoader, Load, Loader, LoaderName, loader_of, unnest_columns
from .sink import SinkName
from .statements import statements

STREAM_ROWS: Final = 2_000
"""Keyframes and observations that wait before a rebuild writes them: enough to make COPY's round
trips vanish, few enough that the server has something to do from early on."""
EARLY: Final[frozenset[Label]] = frozenset({"Observation"})
"""Labels that a rebuild indexes before it writes them. That costs the server more than afterwards,
but it has the time while the fold goes on; afterwards everybody would wait."""
LATE: Final = frozenset(LABELS) - EARLY
SMALL_BATCH: Final = 200
"""Below this many rows an INSERT, sent down the pipeline, beats COPY's extra round trips."""


class GraphSink:
    """Implements `projections.database.sink.Sink` for the graph ``semantic_map``."""

    name: Final[SinkName] = "graph"
    rebuilds_from_view: Final = True

    def __init__(self, loader: LoaderName = "copy") -> None:
        self._loader: Loader = loader_of(loader)
        self._rows = GraphRows()
        self._whole = WholeGraph()

    def note(self, deltas: Sequence[Delta], logged_ns: int, view: MapView) -> None:  # noqa: ARG002 - the port
        """Remember what ``deltas`` change."""
        self._rows.note(deltas, view)

    def take(self, view: MapView) -> GraphChanges:
        """What changed since the last take."""
        return self._rows.take(view)

    def ensure(self, connection: Connection) -> bool:
        """Create an empty graph if there is none."""
        ensure_extension(connection, "age")
        if _graph_ddl.exists(connection, GRAPH):
            return False
        _graph_ddl.create(connection, GRAPH)
        _graph_ddl.index(connection, GRAPH)
        return True

    def few(self, changes: GraphChanges) -> bool:
        """True when the new rows are so few that they are not worth a COPY."""
        return sum(map(len, changes.inserted.values())) < SMALL_BATCH

    def write(self, connection: Connection, changes: GraphChanges) -> None:
        """Insert, upsert and delete what was taken."""
        copies = not self.few(changes) and not policies_apply(connection)
        loader = self._loader if copies else InsertLoader()
        for label, rows in changes.inserted.items():
            _new_rows(loader, GRAPH, label, rows)(connection)
        for label, rows in changes.upserted.items():
            kind = "upsert_vertex" if label in VERTEX_LABELS else "upsert_edge"
            unnest_columns(kind, GRAPH, label, rows)(connection)
        for label, ids in changes.deleted.items():
            query = statements("graph")["delete"].format(
                graph=sql.Identifier(GRAPH), label=sql.Identifier(label)
            )
            connection.execute(query, [[str(i) for i in ids]])

    def clear(self, connection: Connection) -> None:
        """Drop a replaced graph that a reader held on to; refuse a graph that is not ours.

        Not inside the rebuild's transaction: AGE 1.5 crashes the session that drops a graph after
        it has made another one in the same transaction.
        """
        ensure_extension(connection, "age")
        _graph_ddl.exists(connection, GRAPH)
        if swap.try_drop_lock(connection, self.name):
            for graph in (OLD_GRAPH, NEXT_GRAPH):
                with connection.transaction():
                    _graph_ddl.drop(connection, graph)

    def begin(self, connection: Connection) -> None:
        """Create an empty shadow graph, its early indexes with it."""
        _graph_ddl.create(connection, NEXT_GRAPH)
        _graph_ddl.index(connection, NEXT_GRAPH, EARLY)

    def take_final(self, view: MapView) -> GraphChanges | None:
        """Fixed rows, if enough of them wait."""
        return self._whole.take_fixed(view) if self._whole.waiting(view) >= STREAM_ROWS else None

    def take_rest(self, view: MapView) -> GraphChanges:
        """All rows that are still missing."""
        return self._whole.take_rest(view)

    def load(self, changes: GraphChanges) -> Load:
        """What writes rows to the shadow, where none of them is yet."""
        loads = [
            _new_rows(self._loader, NEXT_GRAPH, label, rows)
            for label, rows in changes.inserted.items()
        ]

        def load(connection: Connection) -> None:
            for each in loads:
                each(connection)

        return load

    def index(self, connection: Connection) -> None:
        """Index the shadow and gather its statistics."""
        _graph_ddl.index(connection, NEXT_GRAPH, LATE)
        _graph_ddl.analyze(connection, NEXT_GRAPH)

    def check(self, connection: Connection, view: MapView) -> Mapping[str, int]:
        """Compare counts by label."""
        found, expected = _graph_ddl.counts(connection, NEXT_GRAPH), view.counts()
        wrong = [
            f"{label}: {found[label]} rows, {expected[COUNT_KEYS[label]]} in the map"
            for label in LABELS
            if found[label] != expected[COUNT_KEYS[label]]
        ]
        if wrong:
            raise DatabaseError(
                f"{describe_connection(connection)}: the rebuilt graph does not match the map"
                f" ({'; '.join(wrong)}); the old one stays, please report this"
            )
        return found

    def lock(self, connection: Connection) -> None:
        """Keep readers away from the graph."""
        swap.wait_for_drop(connection, self.name)
        _graph_ddl.lock(connection, GRAPH)

    def swap(self, connection: Connection) -> None:
        """Put the shadow in the readers' place, open to the same roles."""
        copy_privileges(connection, GRAPH, NEXT_GRAPH)
        _graph_ddl.swap_in(connection, NEXT_GRAPH)

    def tidy(self, connection: Connection) -> None:
        """Have the replaced graph dropped once its last reader is gone."""
        if swap.wait_for_earlier_transactions(connection) and swap.try_drop_lock(
            connection, self.name
        ):
            _graph_ddl.leave_dropping(connection, OLD_GRAPH)


def _new_rows(loader: Loader, graph: str, label: Label, rows: list[Any]) -> Load:
    if label in EDGE_LABELS:
        return loader.edges(graph, label, rows)
    return loader.vertices(graph, label, rows)  # type: ignore[arg-type]
