"""Keyframes within ε of each other at any offset, for explaining and drawing merges.

Core points are counted by the rule of the fold, exactly and from the poses alone: a keyframe is a
core point when at least ``min_samples`` posed keyframes, itself included, are within ε of it,
inclusive. Those on two floors never are.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import Offset
from projections.fold.deltas import KeyframeOrdinal
from projections.fold.exact import distance_um, metres_to_um
from projections.fold.floors import shift_um
from projections.fold.settings import Settings

from .columns import NONE
from .tables import Tables


class Posed(NamedTuple):
    """The keyframes that have a pose, in order, as columns: their ordinals, the events that added
    them, positions in µm, and the floor of each as a number from 0 in the order of the first."""

    numbers: NDArray[np.int64]
    offsets: NDArray[np.int64]
    positions: NDArray[np.int64]
    floors: NDArray[np.int64]


def posed(tables: Tables) -> Posed:
    """The keyframes that have a pose."""
    numbers = np.flatnonzero(tables.column("keyframe", "pose"))
    x, y = (tables.integers("keyframe", each)[numbers] for each in ("x_um", "y_um"))
    codes, strings = tables.codes("keyframe", "floor")
    names: dict[str | None, int] = {}
    unique, first, inverse = np.unique(codes[numbers], return_index=True, return_inverse=True)
    number_of = np.zeros(len(unique), np.int64)
    for place in np.argsort(first).tolist():
        name = None if unique[place] == NONE else strings[unique[place]]
        number_of[place] = names.setdefault(name, len(names))
    offsets = tables.integers("keyframe", "offset")[numbers]
    return Posed(numbers, offsets, np.stack([x, y], axis=1), number_of[inverse])


class Neighbours:
    """The poses of keyframes in a grid of cell size ε."""

    def __init__(self, posed: Posed, settings: Settings) -> None:
        self._radius = metres_to_um(settings.eps_m)
        self._min_samples = settings.min_samples
        self._numbers, self._offsets = posed.numbers, posed.offsets
        floors = int(posed.floors.max()) + 1 if len(posed.floors) else 0
        shifts = np.array([shift_um(floor) for floor in range(floors)], np.int64).reshape(-1, 2)
        self._shifts = shifts[posed.floors]
        self._positions = posed.positions + self._shifts
        self._cells = _rows_by_cell(self._positions // self._radius)

    def of(self, keyframe: KeyframeOrdinal, end: Offset) -> list[KeyframeOrdinal]:
        """Ordinals, ascending, of the keyframes within ε of a posed ``keyframe`` after ``end``
        events; itself included."""
        x, y = self._positions[self._row(keyframe)]
        column, row = int(x) // self._radius, int(y) // self._radius
        around = [(column + i, row + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        rows = np.concatenate([self._cells[cell] for cell in around if cell in self._cells])
        rows = np.sort(rows[rows < np.searchsorted(self._offsets, end)])
        # In these cells a difference is at most 2·10⁹ µm, so its square fits int64.
        near = ((self._positions[rows] - (x, y)) ** 2).sum(axis=1) <= self._radius**2
        numbers: list[KeyframeOrdinal] = self._numbers[rows[near]].tolist()
        return numbers

    def is_core(self, keyframe: KeyframeOrdinal, end: Offset) -> bool:
        """Whether it is a core point after ``end`` events; false before it was recorded."""
        row = self._find(keyframe)
        if row is None or self._offsets[row] >= end:
            return False
        return len(self.of(keyframe, end)) >= self._min_samples

    def made_core(self, bridge: KeyframeOrdinal, offset: Offset) -> list[KeyframeOrdinal]:
        """The keyframes that became core points when ``bridge`` was added at ``offset``."""
        if self._find(bridge) is None:
            return []
        return [
            keyframe
            for keyframe in self.of(bridge, Offset(offset + 1))
            if self.is_core(keyframe, Offset(offset + 1)) and not self.is_core(keyframe, offset)
        ]

    def distance_um(self, a: KeyframeOrdinal, b: KeyframeOrdinal) -> int:
        """The distance of two posed keyframes, rounded down."""
        (ax, ay), (bx, by) = (map(int, self._positions[self._row(k)]) for k in (a, b))
        return distance_um(ax, ay, bx, by)

    def _find(self, keyframe: KeyframeOrdinal) -> int | None:
        """The row of a keyframe, None for one without a pose."""
        row = int(np.searchsorted(self._numbers, keyframe))
        found = row < len(self._numbers) and self._numbers[row] == keyframe
        return row if found else None

    def _row(self, keyframe: KeyframeOrdinal) -> int:
        """The row of a posed keyframe."""
        row = self._find(keyframe)
        if row is None:
            raise KeyError(keyframe)
        return row

    def positions(self, keyframes: Sequence[KeyframeOrdinal]) -> NDArray[np.float64]:
        """Positions of posed keyframes in metres, shape (n, 2)."""
        rows = [self._row(k) for k in keyframes]
        metres: NDArray[np.float64] = (self._positions[rows] - self._shifts[rows]) / 1e6
        return metres


def _rows_by_cell(cells: NDArray[np.int64]) -> dict[tuple[int, int], NDArray[np.int64]]:
    """By cell the indices, ascending, of its rows in ``cells``, shape (n, 2)."""
    if not len(cells):
        return {}
    order = np.lexsort((cells[:, 1], cells[:, 0]))  # stable, so rows stay ascending
    found = cells[order]
    starts = np.flatnonzero((found[1:] != found[:-1]).any(axis=1)) + 1
    firsts = found[np.concatenate(([0], starts))]
    keys = [(column, row) for column, row in firsts.tolist()]
    return dict(zip(keys, np.split(order, starts), strict=True))
