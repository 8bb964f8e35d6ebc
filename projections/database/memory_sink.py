"""The sink that keeps the rows in memory: the fake beside the port, published for tests.

It holds exactly what the databases hold, in plain dictionaries, and takes the same changes. What it
has after a series of batches is what the real sinks must have.
"""

from collections.abc import Sequence
from typing import Any

from eventsrc.log import Event
from projections.deltas import Delta
from projections.model.view import MapView

from .graph_rows import GraphChanges, GraphRows
from .labels import LABELS, Label
from .vector_rows import VectorRow, VectorRows


class MemorySink:
    """Rows by id: ``graph[label][graphid]`` and ``vectors[det_pk]``; ``next_offset`` goes along."""

    def __init__(self) -> None:
        self.next_offset = 0
        self.graph: dict[Label, dict[int, Any]] = {label: {} for label in LABELS}
        self.vectors: dict[int, VectorRow] = {}
        self._graph_rows = GraphRows()
        self._vector_rows = VectorRows()

    def note(self, deltas: Sequence[Delta], logged_ns: int, view: MapView) -> None:
        """Remember what ``deltas`` change."""
        self._graph_rows.note(deltas, view)
        self._vector_rows.note(deltas, logged_ns)

    def take(self, view: MapView) -> tuple[GraphChanges, list[VectorRow]]:
        """What changed since the last take."""
        return self._graph_rows.take(view), self._vector_rows.take(view)

    def write(self, changes: tuple[GraphChanges, list[VectorRow]], last: Event) -> None:
        """Take the changes in, up to and with event ``last``."""
        graph, vectors = changes
        for rows_of in (graph.inserted, graph.upserted):
            for label, rows in rows_of.items():
                self.graph[label].update((row[0], row) for row in rows)
        for label, ids in graph.deleted.items():
            for i in ids:
                self.graph[label].pop(i, None)
        self.vectors.update((row.det_pk, row) for row in vectors)
        self.next_offset = last.offset + 1
