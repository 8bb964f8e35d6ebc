"""Cells around centres, and the driven distances between them, up to a reach.

A pose farther than ``cell_um`` from all centres becomes the centre of a new cell; every other
belongs to the cell of the nearest centre, of equally near ones to the earliest. Centres never move.
Where walls are known, only centres count to which there is a straight way.

Two cells with one pose after the other in some run are *linked*, at the distance of their centres.
Where walls are known, it is how far the straight way between them counts as, and cells whose
centres are up to two cells' radii apart are linked, too, if there is such a way: the robot could
drive it. What is linked stays as it is when walls become known, or others.
The driven distance of two cells is the length of the shortest way over links; from ``reach_um`` on
it is not known and counts as ``reach_um``. It only ever gets shorter.

There are at most some 2.3 centres a ``cell_um``², so a cell has a bounded number of others within
reach, however often the robot comes. A keyframe that makes no new link costs a look at the centres
in nine squares of a grid. A new link is taken into the distances of all pairs that it brings
nearer: exactly those (a, b) with a nearer to one end through the link than around it, and b to the
other.

Distances are integer micrometres, those of two centres rounded down.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias

import numpy as np

from . import State
from .exact import distance_um

StraightWay: TypeAlias = Callable[[tuple[int, int], tuple[int, int]], int | None]
"""A function that returns the length of the straight way between two positions, all in µm; None
where walls are in between."""
WayAt: TypeAlias = Callable[[tuple[int, int]], StraightWay | None]
"""The straight ways on the floor of a position; None where no walls are known on that floor."""


class Nearer(NamedTuple):
    """The driven distance of two cells fell from ``before_um``, at most the reach, to
    ``distance_um``."""

    a: int
    b: int
    before_um: int
    distance_um: int


class DrivenCells:
    """The cells and their driven distances; cells are numbered in the order of creation."""

    def __init__(self, cell_um: int, reach_um: int, way_at: WayAt | None = None) -> None:
        self._cell_um = cell_um
        self._cell2 = cell_um * cell_um
        self.reach_um = reach_um
        self.way_at = way_at
        self.centres: list[tuple[int, int]] = []
        # By square of the grid of side ``cell_um``: the cells with their centres in it, and the
        # cells that a position in it may belong to, with their centres.
        self._squares: dict[tuple[int, int], list[int]] = {}
        self._around: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
        # Per cell: the cells within reach, without itself, with their driven distances.
        self.near: list[dict[int, int]] = []
        self._linked: list[set[int]] = []

    def find(self, x_um: int, y_um: int) -> int | None:
        """The cell of a position; None if no centre is near enough."""
        if self.way_at is not None and (way := self.way_at((x_um, y_um))) is not None:
            return self._find_between_walls((x_um, y_um), way)
        best, least = None, self._cell2 + 1
        key = x_um // self._cell_um, y_um // self._cell_um
        for cell, x, y in self._around.get(key, ()):  # ascending
            squared = (x - x_um) ** 2 + (y - y_um) ** 2
            if squared < least:
                best, least = cell, squared
        return best

    def _find_between_walls(self, at: tuple[int, int], way: StraightWay) -> int | None:
        around = self._around.get((at[0] // self._cell_um, at[1] // self._cell_um), ())
        near = sorted(((x - at[0]) ** 2 + (y - at[1]) ** 2, cell) for cell, x, y in around)
        for squared, cell in near:
            if squared > self._cell2:
                break
            if way(self.centres[cell], at) is not None:
                return cell
        return None

    def add(self, x_um: int, y_um: int) -> int:
        """A new cell with its centre here, linked to none."""
        cell = len(self.centres)
        self.centres.append((x_um, y_um))
        column, row = x_um // self._cell_um, y_um // self._cell_um
        self._squares.setdefault((column, row), []).append(cell)
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                key = column + dx, row + dy
                self._around.setdefault(key, []).append((cell, x_um, y_um))
        self.near.append({})
        self._linked.append(set())
        return cell

    def is_linked(self, a: int, b: int) -> bool:
        """Whether two cells are linked or the same."""
        return a == b or b in self._linked[a]

    def link(self, a: int, b: int) -> Iterator[Nearer]:
        """Link two cells; yields the pairs that come nearer by it, each once, in no order.

        A link with walls in between is recorded, too, and brings nothing nearer.
        """
        self._linked[a].add(b)
        self._linked[b].add(a)
        start, end = self.centres[a], self.centres[b]
        way = None if self.way_at is None else self.way_at(start)
        length = distance_um(*start, *end) if way is None else way(start, end)
        if length is None or length >= self.near[a].get(b, self.reach_um):
            return
        # The ends' own sides: nearer to the far end through the link than they were to it.
        sources = [(a, length), *self._through(a, b, length)]
        goals = [(b, 0), *((c, d - length) for c, d in self._through(b, a, length))]
        for source, to_b in sources:
            near = self.near[source]
            for goal, from_b in goals:
                distance, known = to_b + from_b, near.get(goal, self.reach_um)
                if distance < known:
                    near[goal] = self.near[goal][source] = distance
                    yield Nearer(source, goal, known, distance)

    def _through(self, end: int, far: int, length: int) -> Iterator[tuple[int, int]]:
        """The cells near one end of a new link that are nearer to its far end through it, and how
        near."""
        known, reach = self.near[far], self.reach_um
        for cell, distance in self.near[end].items():
            if cell != far and distance + length < known.get(cell, reach):
                yield cell, distance + length

    def with_a_way_to(self, cell: int) -> list[int]:
        """The cells that are linked to a new one by a straight way, where walls are known."""
        at = self.centres[cell]
        way = None if self.way_at is None else self.way_at(at)
        if way is None:
            return []
        column, row = at[0] // self._cell_um, at[1] // self._cell_um
        around = sorted(
            other
            for dx in range(-2, 3)
            for dy in range(-2, 3)
            for other in self._squares.get((column + dx, row + dy), ())
            if other != cell and self._is_within_two_radii(other, at)
        )
        return [other for other in around if way(self.centres[other], at) is not None]

    def _is_within_two_radii(self, cell: int, at: tuple[int, int]) -> bool:
        x, y = self.centres[cell]
        return (x - at[0]) ** 2 + (y - at[1]) ** 2 <= 4 * self._cell2

    def dump(self) -> State:
        """The whole state, to be kept."""
        links = [(a, b) for a, linked in enumerate(self._linked) for b in sorted(linked) if a < b]
        near = [(a, b, d) for a, each in enumerate(self.near) for b, d in sorted(each.items())]
        return {
            "anchors": [[x, y] for x, y in self.centres],
            "links": np.array(links, np.int32).reshape(-1, 2),
            "near": np.array([each for each in near if each[0] < each[1]], np.int64).reshape(-1, 3),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        for x, y in state["anchors"]:
            self.add(x, y)
        for a, b in state["links"].tolist():
            self._linked[a].add(b)
            self._linked[b].add(a)
        for a, b, distance in state["near"].tolist():
            self.near[a][b] = self.near[b][a] = distance
