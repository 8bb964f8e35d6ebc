"""Incremental index of core points under Euclidean distance, and of which clusters touch.

Points live in the cells of a grid. The cells are so small that all points of one are neighbours:
two points of a half-open integer cell of side s differ by at most s - 1 in each axis, so with
s = ⌊√(ε²/2)⌋ + 1 they are within ε. As 2s > ε√2, a neighbour is at most two cells away in each
axis, and not in the corners of that 5 × 5 block: 20 cells beside the point's own (Gan and Tao,
"DBSCAN Revisited", SIGMOD 2015).

A cell with ``min_samples`` points is *dense*: all of its points are core. All core points of any
cell are one cluster. Hence a dense cell needs no counts and no neighbour lists, however often the
robot returns. Only points that are not core yet have a count of neighbours; there are fewer than
``min_samples`` of them in a cell, none in a dense one.

A point that arrives in a sparse cell is counted against its neighbours, dense cells included. That
scan stops at ``min_samples`` and can happen to a cell fewer than ``min_samples`` times in its life.
Whether a point reaches a core point of another cell is answered by `ReachIndex` for a dense cell,
and for a sparse one by looking at its few core points.
"""

import math
from array import array
from collections.abc import Container, Iterable

import numpy as np

from . import State
from .reach_index import ReachIndex, from_side

NEIGHBOUR_CELLS = tuple(
    (dx, dy)
    for dx in range(-2, 3)
    for dy in range(-2, 3)
    if (dx, dy) != (0, 0) and abs(dx) + abs(dy) < 4
)


def cell_side_um(eps_um: int) -> int:
    """The side of a cell for ε, both in micrometres."""
    return math.isqrt(eps_um * eps_um // 2) + 1


_SCAN_POINTS = 4096
_NUMPY_FROM = 24
"""The number of points below which a loop is quicker than four numpy calls."""
_NO_POINT = -1


class Cell:
    """A square of the grid. ``core`` is its first core point or `_NO_POINT`.

    ``near`` are the existing cells that may hold neighbours; ``unlinked`` those of them that are
    not known to be one cluster with this cell, see `CoreIndex.mark_one_cluster`. ``sides`` are the
    reach indexes of a dense cell, made on first use.
    """

    __slots__ = (
        "column",
        "core",
        "cores",
        "is_dense",
        "near",
        "non_core",
        "points",
        "row",
        "sides",
        "unlinked",
    )

    def __init__(self, column: int, row: int) -> None:
        self.column = column
        self.row = row
        self.points = array("i")
        self.non_core: list[int] = []
        self.cores: list[int] = []  # core points of a sparse cell; unused once dense
        self.core = _NO_POINT
        self.is_dense = False
        self.near: list[Cell] = []
        self.unlinked: list[Cell] = []
        self.sides: list[ReachIndex | None] | None = None


class CoreIndex:
    """Points and which of them are core, by exact Euclidean distance ≤ ε, self included."""

    def __init__(self, eps_um: int, min_samples: int) -> None:
        self._eps_um = eps_um
        self._eps2 = eps_um * eps_um
        self._side = cell_side_um(eps_um)
        self._min_samples = min_samples
        self.x = array("q")
        self.y = array("q")
        self._cells: dict[tuple[int, int], Cell] = {}
        self._counts: dict[int, int] = {}  # point that is not core → its neighbours so far
        self._newest: Cell | None = None  # where the last point went

    def insert(self, x_um: int, y_um: int) -> list[int]:
        """Add a point and return the indices of the points that it made core, ascending."""
        point = len(self.x)
        self.x.append(x_um)
        self.y.append(y_um)
        cell = self._newest = self._cell_at(x_um, y_um)
        cell.points.append(point)
        fresh = self._count_for_near(cell, x_um, y_um)
        if cell.is_dense:
            fresh.append(point)
        elif len(cell.points) >= self._min_samples:
            fresh += self._make_dense(cell)
            fresh.append(point)
        else:
            fresh += self._insert_sparse(cell, point)
        fresh.sort()
        return fresh

    def is_core(self, point: int) -> bool:
        """True when the point has at least ``min_samples`` neighbours."""
        return point not in self._counts

    def enclosing_core(self, point: int) -> int | None:
        """An older core point of the same cluster, if the new core point cannot have changed any
        other: all cells near it are of that cluster and hold core points only. Else None.

        In explored parts of a house this is so for almost every keyframe.
        """
        cell = self._cell_of(point)
        if cell.unlinked or cell.core in (point, _NO_POINT) or cell.non_core:
            return None
        for near in cell.near:
            if near.non_core:
                return None
        return cell.core

    def enclosing_core_beside(self, point: int, settled: Container[tuple[int, int]]) -> int | None:
        """As `enclosing_core`, but other clusters may be near if they are out of the point's reach
        or in ``settled``: pairs of first core points of cells that will never be one cluster."""
        cell = self._cell_of(point)
        if cell.core in (point, _NO_POINT) or cell.non_core:
            return None
        for near in cell.near:
            if near.non_core:
                return None
        for near in cell.unlinked:
            is_open = near.core != _NO_POINT and (cell.core, near.core) not in settled
            if is_open and self.core_in_reach(near, point) is not None:
                return None
        return cell.core

    def squared_distance(self, a: int, b: int) -> int:
        """The squared distance of two points, in µm²."""
        return (self.x[a] - self.x[b]) ** 2 + (self.y[a] - self.y[b]) ** 2

    def are_neighbours(self, a: int, b: int) -> bool:
        """True when the two are within ε."""
        return self.squared_distance(a, b) <= self._eps2

    def first_core(self, core: int) -> int:
        """The first core point of a core point's cell, which represents the cell."""
        return self._cell_of(core).core

    def put_first(self, core: int) -> None:
        """Make a core point the representative of its cell."""
        self._cell_of(core).core = core

    def cores_around(self, point: int) -> list[tuple[int, Cell | None]]:
        """(the first core point, the cell) of each cell whose cluster may be in reach.

        The point's own cell comes first and as None: there every point is a neighbour. For the
        others, `core_in_reach` decides. Cells that `mark_one_cluster` has named are left out.
        """
        cell = self._cell_of(point)
        around: list[tuple[int, Cell | None]] = []
        if cell.core != _NO_POINT:
            around.append((cell.core, None))
        if cell.unlinked:
            around += [(near.core, near) for near in cell.unlinked if near.core != _NO_POINT]
        return around

    def mark_one_cluster(self, point: int, cell: Cell) -> None:
        """Record that ``cell`` and the core point's own cell are one cluster for good:
        `cores_around` leaves ``cell`` out from now on."""
        own = self._cell_of(point)
        if cell in own.unlinked:
            own.unlinked.remove(cell)

    def core_in_reach(self, cell: Cell, point: int) -> int | None:
        """A core point of ``cell`` within ε of a point in another cell, or None."""
        if cell.is_dense:
            return self._core_of_dense(cell, self.x[point], self.y[point])
        for core in cell.cores:
            if self.are_neighbours(core, point):
                return core
        return None

    def non_core_around(self, point: int) -> list[int]:
        """The points within ε that are not core, without the point itself."""
        cell = self._cell_of(point)
        around = [other for other in cell.non_core if other != point]
        for near in cell.near:
            if near.non_core:
                around += [other for other in near.non_core if self.are_neighbours(other, point)]
        return around

    def dump(self) -> State:
        """The whole state, to be kept. Cells come in the order in which they were made."""
        cells = self._cells.values()
        sparse = [point for cell in cells for point in cell.cores]
        return {
            "x": np.array(self.x, np.int64),
            "y": np.array(self.y, np.int64),
            "loose": np.array(list(self._counts), np.int32),
            "counts": np.array(list(self._counts.values()), np.int32),
            "core": np.array([cell.core for cell in cells], np.int32),
            "sparse_cores": np.array(sparse, np.int32),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`. Links between cells and reach indexes are computed again."""
        self.x = array("q", state["x"].tobytes())
        self.y = array("q", state["y"].tobytes())
        self._counts = dict(zip(state["loose"].tolist(), state["counts"].tolist(), strict=True))
        for point, (x_um, y_um) in enumerate(zip(self.x, self.y, strict=True)):
            cell = self._cell_at(x_um, y_um)
            cell.points.append(point)
            if point in self._counts:
                cell.non_core.append(point)
        for cell, core in zip(self._cells.values(), state["core"].tolist(), strict=True):
            cell.core = core
            cell.is_dense = len(cell.points) >= self._min_samples
        for point in state["sparse_cores"].tolist():
            self._cell_at(self.x[point], self.y[point]).cores.append(point)

    def _cell_of(self, point: int) -> Cell:
        """The point's own cell, quickest for the newest point."""
        if point == len(self.x) - 1 and self._newest is not None:
            return self._newest
        return self._cell_at(self.x[point], self.y[point])

    def _cell_at(self, x_um: int, y_um: int) -> Cell:
        key = x_um // self._side, y_um // self._side
        cell = self._cells.get(key)
        return self._new_cell(*key) if cell is None else cell

    def _new_cell(self, column: int, row: int) -> Cell:
        cell = self._cells[column, row] = Cell(column, row)
        for dx, dy in NEIGHBOUR_CELLS:
            near = self._cells.get((column + dx, row + dy))
            if near is not None:
                cell.near.append(near)
                cell.unlinked.append(near)
                near.near.append(cell)
                near.unlinked.append(cell)
        return cell

    def _count_for_near(self, cell: Cell, x_um: int, y_um: int) -> list[int]:
        """Count the newcomer as a neighbour of non-core points in the near cells; return those it
        made core."""
        fresh = []
        for near in cell.near:
            if near.non_core:
                for other in near.non_core:
                    distance2 = (self.x[other] - x_um) ** 2 + (self.y[other] - y_um) ** 2
                    if distance2 <= self._eps2 and self._add_neighbour(other):
                        fresh.append(other)
                if fresh:
                    self._promote(near, fresh)
        return fresh

    def _add_neighbour(self, point: int) -> bool:
        """Count one more neighbour of a non-core point; True when that makes it core."""
        self._counts[point] += 1
        return self._counts[point] >= self._min_samples

    def _promote(self, cell: Cell, fresh: Iterable[int]) -> None:
        """Make core those of the cell's non-core points that are among ``fresh``."""
        promoted = [point for point in cell.non_core if point in fresh]
        for point in promoted:
            cell.non_core.remove(point)
            del self._counts[point]
        cell.cores += promoted
        if promoted and cell.core == _NO_POINT:
            cell.core = promoted[0]

    def _make_dense(self, cell: Cell) -> list[int]:
        """Make all points of the cell core; return those that were not, without the newest."""
        fresh = cell.non_core
        for point in fresh:
            del self._counts[point]
        cell.is_dense = True
        cell.non_core = []
        cell.cores = []
        if cell.core == _NO_POINT:
            cell.core = cell.points[0]
        return fresh

    def _insert_sparse(self, cell: Cell, point: int) -> list[int]:
        """Count the neighbours of the newcomer, the last of ``cell.points``, and count it for its
        cell's non-core points; return the points that it made core."""
        fresh = [other for other in cell.non_core if self._add_neighbour(other)]
        count = len(cell.points)
        for near in cell.near:
            if count >= self._min_samples:
                break
            wanted = self._min_samples - count
            count += self._count_within(near, self.x[point], self.y[point], wanted)
        self._counts[point] = count
        cell.non_core.append(point)
        if count >= self._min_samples:
            fresh.append(point)
        self._promote(cell, fresh)
        return fresh

    def _count_within(self, cell: Cell, x_um: int, y_um: int, limit: int) -> int:
        """The number of points of the cell within ε; counting may stop at ``limit``.

        Exact in int64: neighbours' cells bound both differences by 3·side, so the sum of squares
        is below 9·ε² ≤ 9·10¹⁸ for the largest ε that settings allow.
        """
        count = 0
        if len(cell.points) < _NUMPY_FROM:
            x, y, eps2 = self.x, self.y, self._eps2
            for point in cell.points:
                count += (x[point] - x_um) ** 2 + (y[point] - y_um) ** 2 <= eps2
            return count
        for start in range(0, len(cell.points), _SCAN_POINTS):
            points = np.array(cell.points[start : start + _SCAN_POINTS])
            dx = np.frombuffer(self.x, np.int64)[points] - x_um
            dy = np.frombuffer(self.y, np.int64)[points] - y_um
            count += int(np.count_nonzero(dx * dx + dy * dy <= self._eps2))
            if count >= limit:
                break
        return count

    def _core_of_dense(self, cell: Cell, x_um: int, y_um: int) -> int | None:
        column = x_um // self._side
        if column != cell.column:
            side = 0 if column < cell.column else 1
        else:
            side = 2 if y_um < cell.row * self._side else 3
        if cell.sides is None:
            cell.sides = [None, None, None, None]
        index = cell.sides[side]
        if index is None:
            index = cell.sides[side] = ReachIndex(self._eps_um)
        for point in cell.points[index.added :]:
            index.add(point, from_side(side, self.x[point], self.y[point]))
        return index.point_in_reach(from_side(side, x_um, y_um))
