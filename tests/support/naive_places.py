"""The rules of `projections.fold.rooms`, word by word, from scratch at every keyframe.

The rules of `projections.fold.constrained_places`, word by word, as slow as can be.
"""

import math
from collections.abc import Callable, Hashable, Iterable
from fractions import Fraction
from itertools import combinations
from typing import Any

import numpy as np

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


Pairs = Iterable[tuple[Hashable, Hashable]]


def group_of(anchor: Hashable, joined: Pairs) -> set[Any]:
    """All anchors that are one with this one by command, itself included."""
    found = {anchor}
    while more := {x for pair in joined if found & set(pair) for x in pair} - found:
        found |= more
    return found


class NaiveConstrainedPlaces:
    """Constrained DBSCAN that looks at every pair of points at every point.

    ``labels``, ``founders`` and ``cores`` are as in `folds.NaivePlaces`; ``refused`` are the
    pairs of places reported so far, ``had_effect`` whether a pair has changed anything. The points
    of a cell, as ``cell_of`` gives it, are all of one place; ``joined`` and ``apart`` are pairs of
    points, or of what ``name_of`` calls them.
    """

    def __init__(
        self,
        min_samples: int,
        cell_of: Callable[[int], Hashable],
        joined: Pairs,
        apart: Pairs,
        name_of: Callable[[int], Hashable] = lambda point: point,
    ) -> None:
        self.min_samples = min_samples
        self.cell_of = cell_of
        self.name_of = name_of
        self.joined, apart = list(joined), list(apart)
        self.anchors = {point for pair in (*self.joined, *apart) for point in pair}
        self.enemies = {
            frozenset((one, other))
            for a, b in apart
            for one in group_of(a, self.joined)
            for other in group_of(b, self.joined)
        }
        self.labels: list[int | None] = []
        self.cores: set[int] = set()
        self.founders: list[int] = []
        self.cell_places: dict[Hashable, int] = {}
        self.inside: list[set[Hashable]] = []  # of each place, its anchors
        self.refused: set[tuple[int, int]] = set()
        self.had_effect = False

    def conflict(self, one: set[Hashable], other: set[Hashable]) -> bool:
        """Whether two sets of anchors may not come together."""
        found = any(frozenset((a, b)) in self.enemies for a in one for b in other)
        self.had_effect |= found
        return found

    def add(self, are_near: np.ndarray) -> None:
        """Take in the last point of the matrix."""
        n = len(are_near)
        self.labels.append(None)
        older, self.cores = (
            self.cores,
            set(np.flatnonzero(are_near.sum(axis=0) >= self.min_samples)),
        )
        self.cores = {int(core) for core in self.cores}
        fresh = sorted(self.cores - older)
        entered = {p for p in fresh if self._is_anchor(p) and self.labels[p] is None}
        self._add_fresh(fresh, are_near)
        for point in sorted(set(range(n)) - self.cores):
            if self.labels[point] is None:
                near = {self.cell_places[self.cell_of(c)] for c in self.cores if are_near[point][c]}
                if self._is_anchor(point):
                    own = {self.name_of(point)}
                    near = {p for p in near if not self.conflict(own, self.inside[p])}
                if near:
                    self.labels[point] = min(near)
                    if self._is_anchor(point):
                        self.inside[min(near)].add(self.name_of(point))
                        entered.add(point)
        for anchor in sorted(entered):
            self._join(anchor)

    def _add_fresh(self, fresh: list[int], are_near: np.ndarray) -> None:
        cells: dict[Hashable, list[int]] = {}
        for core in sorted(self.cores):
            cells.setdefault(self.cell_of(core), []).append(core)
        units: dict[Hashable, tuple[int, int]] = {}
        for cell, points in cells.items():
            placed = [p for point in points if (p := self.labels[point]) is not None]
            if cell in self.cell_places:
                units[cell] = (0, self.cell_places[cell])
            else:
                units[cell] = (0, min(placed)) if placed else (1, points[0])
        sets = {unit: {unit} for unit in units.values()}
        inside = {u: set(self.inside[u[1]]) if u[0] == 0 else set() for u in units.values()}
        for point in fresh:
            if self._is_anchor(point) and self.labels[point] is None:
                inside[units[self.cell_of(point)]].add(self.name_of(point))
        links = sorted(
            (*sorted((units[one], units[other])),)
            for one, other in combinations(cells, 2)
            if any(
                are_near[a][b] and (a in fresh or b in fresh)
                for a in cells[one]
                for b in cells[other]
            )
        )
        refused = []
        for one, other in links:
            if sets[one] is sets[other]:
                continue
            if self.conflict(
                {a for u in sets[one] for a in inside[u]},
                {a for u in sets[other] for a in inside[u]},
            ):
                refused.append((one, other))
            else:
                together = sets[one] | sets[other]
                sets |= dict.fromkeys(together, together)
        place_of: dict[tuple[int, int], int] = {}
        for core in fresh:
            together = sets[units[self.cell_of(core)]]
            if units[self.cell_of(core)] in place_of:
                continue
            known = [number for kind, number in together if kind == 0]
            if known:
                place = min(known)
            else:
                place = len(self.founders)
                self.inside.append(set())
                self.founders.append(min(p for p in fresh if units[self.cell_of(p)] in together))
            place_of |= dict.fromkeys(together, place)
            self._rename(known, place)
        for cell, unit in units.items():
            if unit in place_of:
                self.cell_places[cell] = place_of[unit]
        for point in fresh:
            if self.labels[point] is None:
                self.labels[point] = self.cell_places[self.cell_of(point)]
                if self._is_anchor(point):
                    self.inside[self.labels[point]].add(self.name_of(point))
        for pair in refused:
            a, b = sorted(place_of.get(unit, unit[1]) for unit in pair)
            self.refused.add((a, b))

    def _rename(self, places: Iterable[int], place: int) -> None:
        for other in set(places) - {place}:
            self.labels = [place if label == other else label for label in self.labels]
            for cell, label in self.cell_places.items():
                if label == other:
                    self.cell_places[cell] = place
            self.inside[place] |= self.inside[other]
            self.inside[other] = set()

    def _is_anchor(self, point: int) -> bool:
        return self.name_of(point) in self.anchors

    def _join(self, anchor: int) -> None:
        for other in range(len(self.founders)):
            place = self.labels[anchor]
            if other == place or not self.inside[other] & group_of(
                self.name_of(anchor), self.joined
            ):
                continue
            if self.conflict(self.inside[place], self.inside[other]):
                self.refused.add((min(place, other), max(place, other)))
            else:
                self.had_effect = True
                self._rename([place, other], min(place, other))
