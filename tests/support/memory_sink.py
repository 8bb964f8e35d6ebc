"""The sink that keeps rows in memory: the same rows as the databases, in plain dictionaries.

Tests compare the databases with it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from projections.map.changes import BatchChanges
from projections.map.view import MapView
from projections.postgres.graph_rows import GraphRows, changed_rows, changing_rows, fixed_rows
from projections.postgres.labels import LABELS, TABLE, Label
from projections.postgres.map_table import MapRow, map_rows
from projections.postgres.sink import PreparedWrite
from projections.postgres.vector_rows import VectorRow, new_rows


@dataclass(slots=True)
class MemoryTables:
    """``graph[label][graphid]``, ``vectors[det_pk]`` and ``maps``; ``next_offset`` is their
    checkpoint."""

    next_offset: int = 0
    graph: dict[Label, dict[int, Any]] = field(
        default_factory=lambda: {name: {} for name in LABELS}
    )
    vectors: dict[int, VectorRow] = field(default_factory=dict)
    maps: list[MapRow] = field(default_factory=list)

    def add(self, rows_of: Mapping[Label, list[Any]]) -> None:
        """Insert or replace rows of the graph."""
        for label, rows in rows_of.items():
            self.graph[label].update((row[0], row) for row in rows)

    def add_vectors(self, rows: list[VectorRow]) -> None:
        """Insert or replace rows of ``detection_embeddings``."""
        self.vectors.update((row.det_pk, row) for row in rows)


class MemorySink:
    """Implements `Sink` for both graph and vectors."""

    def ensure(self, connection: MemoryTables) -> bool:
        """Nothing to do: `MemoryTables` begins with its tables."""
        return False

    def prepare(self, changes: BatchChanges, view: MapView) -> PreparedWrite[MemoryTables]:
        """Rows that a batch changed."""
        graph, vectors = changed_rows(changes, view), new_rows(changes, view)
        maps = map_rows(view) if changes.maps else None

        def send(tables: MemoryTables) -> None:
            _write_graph(tables, graph)
            tables.add_vectors(vectors)
            if maps is not None:
                tables.maps = maps

        return PreparedWrite(send, is_small=True)

    def drop_leftovers(self, connection: MemoryTables) -> None:
        """Nothing to do: an unfinished shadow is in no table."""

    def shadow(self) -> "MemoryShadow":
        """A shadow, not created yet."""
        return MemoryShadow()

    def drop_replaced(self, connection: MemoryTables) -> None:
        """Nothing to do: `MemoryShadow.swap_in` keeps no reference to replaced rows."""


class MemoryShadow:
    """Tables beside those that readers see."""

    def __init__(self) -> None:
        self._new = MemoryTables()

    def create(self, connection: MemoryTables) -> None:
        """Create it, empty."""
        self._new = MemoryTables()

    def load(self, changes: BatchChanges, view: MapView) -> Callable[[MemoryTables], None]:
        """Rows of new keyframes and observations that never change again."""
        graph = fixed_rows(view, changes)
        vectors = new_rows(changes, view)

        def load(_: MemoryTables) -> None:
            self._new.add(graph)
            self._new.add_vectors(vectors)

        return load

    def finish(self, view: MapView) -> Callable[[MemoryTables], Mapping[str, int]]:
        """All other rows."""
        graph, maps = changing_rows(view), map_rows(view)

        def finish(_: MemoryTables) -> Mapping[str, int]:
            self._new.add(graph)
            self._new.maps = maps
            rows: dict[str, int] = {label: len(rows) for label, rows in self._new.graph.items()}
            return {**rows, TABLE: len(self._new.vectors)}

        return finish

    def lock_readers(self, connection: MemoryTables) -> None:
        """Nothing to do: `swap_in` has no concurrent readers."""

    def swap_in(self, connection: MemoryTables) -> None:
        """Replace the tables' rows."""
        connection.graph, connection.vectors = self._new.graph, self._new.vectors
        connection.maps = self._new.maps


def _write_graph(tables: MemoryTables, rows: GraphRows) -> None:
    tables.add(rows.inserted)
    tables.add(rows.upserted)
    tables.add(rows.replaced)
    for label, ids in rows.deleted.items():
        for i in ids:
            tables.graph[label].pop(i, None)
