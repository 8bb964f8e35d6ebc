"""The rules of `projections.fold.rooms`, word by word, from scratch at every keyframe."""

import math
from collections.abc import Hashable
from fractions import Fraction
from itertools import combinations

from tests.support.naive_constrained import group_of

Anchored = tuple[int, int]


class NaiveRooms:
    """Places of cells, after each point. ``labels`` is the place of each point's cell, ``founders``
    the points that founded the places, ``refused`` the pairs of places that a command keeps apart,
    ``merges`` of the last point (survivor, absorbed, mean drive, None where a command joined)."""

    def __init__(
        self,
        cell_um: int,
        drive_um: int,
        joined: list[Anchored] = [],  # noqa: B006
        apart: list[Anchored] = [],  # noqa: B006
        way=None,
    ) -> None:
        self.cell_um, self.drive_um = cell_um, drive_um
        self.joined, self.apart, self.way = joined, apart, way
        self.centres: list[tuple[int, int]] = []
        self.links: dict[tuple[int, int], int | None] = {}  # how far, None for barred
        self.points: list[int] = []  # the cell of each
        self.last: dict[Hashable, int] = {}
        self.place_of: list[int] = []  # of each cell
        self.founders: list[int] = []
        self.refused: set[tuple[int, int]] = set()
        self.merges: list[tuple[int, int, Fraction | None]] = []

    @property
    def labels(self) -> list[int]:
        return [self.place_of[cell] for cell in self.points]

    def add(self, run: Hashable, x: int, y: int) -> None:
        point, self.merges = len(self.points), []
        cell = self._nearest(x, y)
        if cell is not None and self._conflict([point], self._anchors_in(self.place_of[cell])):
            cell = None
        is_new = cell is None
        if cell is None:
            cell = len(self.centres)
            self.centres.append((x, y))
            if self.way is not None:
                self._link_by_ways(cell)
        if run in self.last and self.last[run] != cell:
            self._link(self.last[run], cell)
        self.last[run] = cell
        drives = self._drives()
        if is_new:
            self._give_place(point, cell, drives)
        self.points.append(cell)
        self._merge_all(drives)
        self._obey_joins(point, drives)

    def _nearest(self, x: int, y: int) -> int | None:
        near = [
            ((ax - x) ** 2 + (ay - y) ** 2, i)
            for i, (ax, ay) in enumerate(self.centres)
            if self._way((ax, ay), (x, y)) is not None
        ]
        return min(near)[1] if near and min(near)[0] <= self.cell_um**2 else None

    def _way(self, a: tuple[int, int], b: tuple[int, int]) -> int | None:
        return (
            math.isqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2)
            if self.way is None
            else self.way(a, b)
        )

    def _link(self, a: int, b: int) -> None:
        """How far it is counts as of now, whatever walls there will be."""
        a, b = sorted((a, b))
        if (a, b) not in self.links:
            self.links[a, b] = self._way(self.centres[a], self.centres[b])

    def _link_by_ways(self, cell: int) -> None:
        for other in range(cell):
            squared = sum(
                (a - b) ** 2 for a, b in zip(self.centres[other], self.centres[cell], strict=True)
            )
            way = self._way(self.centres[other], self.centres[cell])
            if squared <= 4 * self.cell_um**2 and way is not None:
                self._link(other, cell)

    def _drives(self) -> list[list[int]]:
        """Floyd and Warshall: the shortest drive from each cell to each, at most twice the
        limit."""
        n, reach = len(self.centres), 2 * self.drive_um
        drives = [[0 if i == j else reach for j in range(n)] for i in range(n)]
        for (i, j), length in self.links.items():
            if length is not None:
                drives[i][j] = drives[j][i] = min(length, reach)
        for k, through in enumerate(drives):
            for row in drives:
                if row[k] < reach:
                    row[:] = [min(d, row[k] + more) for d, more in zip(row, through, strict=True)]
        return drives

    def _cells(self, place: int) -> list[int]:
        return [cell for cell, p in enumerate(self.place_of) if p == place]

    def _mean(self, some: list[int], others: list[int], drives: list[list[int]]) -> Fraction:
        total = sum(drives[a][b] for a in some for b in others)
        return Fraction(total, len(some) * len(others))

    def _give_place(self, point: int, cell: int, drives: list[list[int]]) -> None:
        means = [
            (self._mean([cell], self._cells(place), drives), place)
            for place in sorted(set(self.place_of))
            if not self._conflict([point], self._anchors_in(place))
        ]
        if means and min(means)[0] <= self.drive_um:
            self.place_of.append(min(means)[1])
        else:
            self.place_of.append(len(self.founders))
            self.founders.append(point)

    def _merge_all(self, drives: list[list[int]]) -> None:
        while True:
            close = [
                (mean, pair)
                for pair in combinations(sorted(set(self.place_of)), 2)
                if (mean := self._mean(*map(self._cells, pair), drives)) <= self.drive_um
            ]
            free = [
                (mean, pair)
                for mean, pair in close
                if not self._conflict(*map(self._anchors_in, pair))
            ]
            if not free:
                self.refused |= {pair for _, pair in close}
                return
            mean, pair = min(free)
            self._merge(pair, mean)

    def _merge(self, pair: tuple[int, int], mean: Fraction | None) -> None:
        self.place_of = [pair[0] if place == pair[1] else place for place in self.place_of]
        self.merges.append((*pair, mean))

    def _anchors_in(self, place: int) -> list[int]:
        """Points that a command names, in a place."""
        named = {p for pair in (*self.joined, *self.apart) for p in pair}
        return [p for p, label in enumerate(self.labels) if label == place and p in named]

    def _conflict(self, some: list[int], others: list[int]) -> bool:
        return any(
            (a in group_of(p, self.joined) and b in group_of(q, self.joined))
            or (b in group_of(p, self.joined) and a in group_of(q, self.joined))
            for p in some
            for q in others
            for a, b in self.apart
        )

    def _obey_joins(self, point: int, drives: list[list[int]]) -> None:
        group = group_of(point, self.joined) - {point}
        while True:
            own = self.labels[point]
            others = sorted({self.labels[p] for p in group if p < point} - {own})
            pairs = [(min(own, other), max(own, other)) for other in others]
            free = [pair for pair in pairs if not self._conflict(*map(self._anchors_in, pair))]
            if not free:
                self.refused |= set(pairs)
                return
            self._merge(free[0], None)
            self._merge_all(drives)
