"""The rows of a history's tables below an offset, from which the map at that offset is made."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from eventsrc.envelope.model import Offset
from projections.fold.deltas import ObjectOrdinal

from .columns import NO_INT, NONE, Array
from .history import History, placed_columns
from .tables import Groups, Rows, last_rows


class Moment:
    """The rows of a history below ``end``."""

    def __init__(self, history: History, end: Offset) -> None:
        self.tables, self.end = history.tables, end
        self._counts: dict[str, int] = {}
        self.merges = history.merges[: self.count("merge")] if self.count("merge") else ()
        both = (self.column("fused", each).tolist() for each in ("survivor", "absorbed"))
        self.object_merges: list[tuple[ObjectOrdinal, ObjectOrdinal]] = list(
            zip(*both, strict=True)
        )
        """(survivor, absorbed) of each merge of Objects, in order."""

    def count(self, table: str) -> int:
        if table not in self._counts:
            self._counts[table] = self.tables.before(table, self.end)
        return self._counts[table]

    def column(self, table: str, column: str) -> Array:
        return self.tables.column(table, column, self.count(table))

    def deltas(self, table: str) -> list[Any]:
        return self.tables.deltas(table, 0, self.count(table))

    def last(self, table: str, column: str, size: int) -> Rows:
        """For each value 0 … ``size`` − 1 of a column, the last row that has it; -1 for none."""
        if not self.count(table):
            return np.full(size, NONE, np.int64)
        return last_rows(self.column(table, column), size)

    def last_deltas(self, table: str, column: str, size: int) -> list[Any]:
        """As `last`, with the deltas that are the rows; None for none."""
        last = self.last(table, column, size)
        rows = iter(self.tables.deltas_at(table, last[last >= 0]))
        return [next(rows) if row >= 0 else None for row in last.tolist()]

    @cached_property
    def placed(self) -> tuple[Array, Array]:
        return placed_columns(self.tables, self.end)

    @cached_property
    def members(self) -> Groups:
        """Keyframes by the place that they are in."""
        _, joined = self.placed
        survivors = _survivors(self.count("formed"), self.place_pairs)
        keyframes = np.flatnonzero(joined >= 0)
        return Groups(survivors[joined[keyframes]], keyframes)

    @cached_property
    def observation_starts(self) -> Rows:
        """By keyframe its first observation, and at the end the number of observations."""
        keyframes = np.arange(self.count("keyframe") + 1)
        return np.searchsorted(self.column("observation", "keyframe"), keyframes)

    @property
    def place_pairs(self) -> list[tuple[int, int]]:
        """(survivor, absorbed) of each merge of places, in order."""
        return [(m.survivor, absorbed) for m in self.merges for absorbed in m.absorbed]

    @cached_property
    def absorbed_objects(self) -> set[ObjectOrdinal]:
        return {absorbed for _, absorbed in self.object_merges}

    @cached_property
    def survivors_of_objects(self) -> set[ObjectOrdinal]:
        return {survivor for survivor, _ in self.object_merges}

    @cached_property
    def object_of_seen(self) -> Array:
        """By row of ``seen`` the object that its observation is part of."""
        found = _survivors(self.count("found"), self.object_merges)
        return found[self.column("seen", "object")]

    @property
    def is_fused(self) -> Array:
        """By observation whether it is part of an object."""
        found = np.zeros(self.count("observation"), np.bool_)
        found[self.column("seen", "observation")] = True
        return found

    @cached_property
    def fused(self) -> tuple[Array, Array]:
        """By observation the object that it is part of, -1 for none, and its similarity, `NO_INT`
        for none."""
        size, seen = self.count("observation"), self.column("seen", "observation")
        objects, similarities = np.full(size, NONE, np.int32), np.full(size, NO_INT, np.int64)
        objects[seen] = self.object_of_seen
        similarities[seen] = self.column("seen", "similarity_q40")
        return objects, similarities

    @cached_property
    def sightings(self) -> Groups:
        """Observations by the object that they are part of, in the order of their rows."""
        return Groups(self.object_of_seen, self.column("seen", "observation"))


def _survivors(count: int, pairs: Sequence[tuple[int, int]]) -> Array:
    """The survivor of each of ``count`` things after the merges ``pairs`` (survivor, absorbed)."""
    found = np.arange(count, dtype=np.int32)
    for survivor, absorbed in reversed(pairs):  # what a survivor is part of is known by then
        found[absorbed] = found[survivor]
    return found
