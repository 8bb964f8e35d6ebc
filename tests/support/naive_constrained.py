"""The rules of `projections.fold.constrained_places`, word by word, as slow as can be."""

from collections.abc import Callable, Hashable, Iterable
from itertools import combinations
from typing import Any

import numpy as np

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
