"""Who is core, for plain distance: counting that stops where it stops mattering.

Points live in the cells of `_grid`. A cell with ``min_samples`` points is *dense*: each of them has
all the others as neighbours, so all are core, and all core points of any cell are one cluster.
Hence a dense cell needs no counts and no neighbour lists, however often the robot returns; only
``loose`` points, not core yet, have a count, and there are fewer than ``min_samples`` of them in a
cell, none in a dense one.

A point that arrives in a sparse cell must be counted against its neighbours, dense ones included;
that scan stops at ``min_samples`` and can happen to a cell fewer than ``min_samples`` times in its
life. Whether two cells' clusters touch is asked of `_fence` when a cell is dense, else of its few
core points.

The grid under DBSCAN: square cells so small that whoever shares one is a neighbour.

Two points of a half-open integer cell of side s differ by at most s - 1 in each axis, so with
s = ⌊√(ε²/2)⌋ + 1 they are within ε. As 2s > ε√2, a neighbour is at most two cells away in each
axis, and not in the corners of that 5 × 5 block: 20 cells beside the point's own (Gan and Tao,
"DBSCAN Revisited", SIGMOD 2015).
"""

import math
from array import array
from collections.abc import Iterable

import numpy as np

from projections.reducers import State

from .reach_index import Fence, turned

NEIGHBOUR_CELLS = tuple(
    (dx, dy)
    for dx in range(-2, 3)
    for dy in range(-2, 3)
    if (dx, dy) != (0, 0) and abs(dx) + abs(dy) < 4
)


def cell_side_um(eps_um: int) -> int:
    """The side of a cell for ε, both in micrometres."""
    return math.isqrt(eps_um * eps_um // 2) + 1


_SCAN = 4096
_FEW = 24  # below, a loop is quicker than four numpy calls


class Cell:
    """A square of the grid. ``core`` is its first core point or -1.

    ``near`` are the existing cells within reach; ``apart`` those of them that are not known to be
    one cluster with this cell, see `Crowd.unite`.
    """

    __slots__ = (
        "apart",
        "column",
        "core",
        "cores",
        "fences",
        "is_dense",
        "loose",
        "near",
        "points",
        "row",
    )

    def __init__(self, column: int, row: int) -> None:
        self.column = column
        self.row = row
        self.points = array("i")
        self.loose: list[int] = []
        self.cores: list[int] = []  # core points of a sparse cell; unused once dense
        self.core = -1
        self.is_dense = False
        self.near: list[Cell] = []
        self.apart: list[Cell] = []
        self.fences: list[Fence | None] | None = None


class Crowd:
    """Points and which of them are core, by exact Euclidean distance ≤ ε, self included."""

    def __init__(self, eps_um: int, min_samples: int) -> None:
        self._eps_um = eps_um
        self._eps2 = eps_um * eps_um
        self._side = cell_side_um(eps_um)
        self._min_samples = min_samples
        self.x = array("q")
        self.y = array("q")
        self._cells: dict[tuple[int, int], Cell] = {}
        self._counts: dict[int, int] = {}
        self._newest: Cell | None = None  # where the last point went

    def insert(self, x_um: int, y_um: int, yaw_rad: float) -> list[int]:  # noqa: ARG002
        """Add a point; the indices of the points that became core by it, ascending."""
        point = len(self.x)
        self.x.append(x_um)
        self.y.append(y_um)
        cell = self._newest = self._cell(x_um, y_um)
        cell.points.append(point)
        fresh = self._count_near(cell, x_um, y_um)
        if cell.is_dense:
            fresh.append(point)
        elif len(cell.points) >= self._min_samples:
            fresh += self._turn_dense(cell)
            fresh.append(point)
        else:
            fresh += self._insert_sparse(cell, point)
        fresh.sort()
        return fresh

    def is_core(self, point: int) -> bool:
        """True when the point has at least ``min_samples`` neighbours."""
        return point not in self._counts

    def settled(self, point: int) -> int | None:
        """An older core point of the same cluster, if the new core point can have changed nothing:
        every cell around is of that cluster too and holds no loose point. Else None.

        A robot at home meets this at almost every keyframe.
        """
        cell = self._home(point)
        if cell.apart or cell.core in (point, -1) or cell.loose:
            return None
        for near in cell.near:
            if near.loose:
                return None
        return cell.core

    def distance2(self, a: int, b: int) -> int:
        """The squared distance of two points, in µm²."""
        return (self.x[a] - self.x[b]) ** 2 + (self.y[a] - self.y[b]) ** 2

    def are_neighbours(self, a: int, b: int) -> bool:
        """True when the two are within ε."""
        return self.distance2(a, b) <= self._eps2

    def cores_around(self, point: int) -> list[tuple[int, Cell | None]]:
        """(a core point, the cell it stands for) for each cell whose cluster may be in reach.

        All core points of a cell are one cluster, so the first stands for them. The own cell comes
        first and as None: there every point is a neighbour. For the others, ask `reach`. Cells
        that `unite` has declared one cluster with the own cell are left out.
        """
        cell = self._home(point)
        around: list[tuple[int, Cell | None]] = [(cell.core, None)] if cell.core >= 0 else []
        if cell.apart:
            around += [(near.core, near) for near in cell.apart if near.core >= 0]
        return around

    def unite(self, point: int, cell: Cell) -> None:
        """Never mention ``cell`` again around the core point's cell: both are one cluster for good,
        and whoever finds the one finds the other."""
        own = self._home(point)
        if cell in own.apart:
            own.apart.remove(cell)

    def reach(self, cell: Cell, point: int) -> int | None:
        """A core point of ``cell`` within ε of a point in another cell, or None."""
        if cell.is_dense:
            return self._reach_dense(cell, self.x[point], self.y[point])
        for core in cell.cores:
            if self.are_neighbours(core, point):
                return core
        return None

    def loose_around(self, point: int) -> list[int]:
        """The points within ε that are not core, without the point itself."""
        cell = self._home(point)
        around = [other for other in cell.loose if other != point]
        for near in cell.near:
            if near.loose:
                around += [other for other in near.loose if self.are_neighbours(other, point)]
        return around

    def dump(self) -> State:
        """Everything, for a snapshot. Cells come in the order in which they were made."""
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
        """Take over what `dump` gave; what cells know of each other is found again when asked."""
        self.x = array("q", state["x"].tobytes())
        self.y = array("q", state["y"].tobytes())
        self._counts = dict(zip(state["loose"].tolist(), state["counts"].tolist(), strict=True))
        for point, (x_um, y_um) in enumerate(zip(self.x, self.y, strict=True)):
            cell = self._cell(x_um, y_um)
            cell.points.append(point)
            if point in self._counts:
                cell.loose.append(point)
        for cell, core in zip(self._cells.values(), state["core"].tolist(), strict=True):
            cell.core = core
            cell.is_dense = len(cell.points) >= self._min_samples
        for point in state["sparse_cores"].tolist():
            self._cell(self.x[point], self.y[point]).cores.append(point)

    def _home(self, point: int) -> Cell:
        """The point's own cell; nearly always it is the newcomer's that is asked for."""
        if point == len(self.x) - 1 and self._newest is not None:
            return self._newest
        return self._cell(self.x[point], self.y[point])

    def _cell(self, x_um: int, y_um: int) -> Cell:
        key = x_um // self._side, y_um // self._side
        cell = self._cells.get(key)
        return self._new_cell(*key) if cell is None else cell

    def _new_cell(self, column: int, row: int) -> Cell:
        cell = self._cells[column, row] = Cell(column, row)
        for dx, dy in NEIGHBOUR_CELLS:
            near = self._cells.get((column + dx, row + dy))
            if near is not None:
                cell.near.append(near)
                cell.apart.append(near)
                near.near.append(cell)
                near.apart.append(cell)
        return cell

    def _count_near(self, cell: Cell, x_um: int, y_um: int) -> list[int]:
        """Count the newcomer for the loose points of the near cells; those that became core."""
        fresh = []
        for near in cell.near:
            if near.loose:
                for other in near.loose:
                    distance2 = (self.x[other] - x_um) ** 2 + (self.y[other] - y_um) ** 2
                    if distance2 <= self._eps2 and self._count(other):
                        fresh.append(other)
                if fresh:
                    self._promote(near, fresh)
        return fresh

    def _count(self, point: int) -> bool:
        """One more neighbour for a loose point; True when that makes it core."""
        self._counts[point] += 1
        return self._counts[point] >= self._min_samples

    def _promote(self, cell: Cell, fresh: Iterable[int]) -> None:
        """Make core those of the cell's loose points that are among ``fresh``."""
        risen = [point for point in cell.loose if point in fresh]
        for point in risen:
            cell.loose.remove(point)
            del self._counts[point]
        cell.cores += risen
        if risen and cell.core < 0:
            cell.core = risen[0]

    def _turn_dense(self, cell: Cell) -> list[int]:
        """All points of the cell are core from now on; those that were not, without the last."""
        fresh = cell.loose
        for point in fresh:
            del self._counts[point]
        cell.is_dense = True
        cell.loose = []
        cell.cores = []
        if cell.core < 0:
            cell.core = cell.points[0]
        return fresh

    def _insert_sparse(self, cell: Cell, point: int) -> list[int]:
        """Count the newcomer, the last of ``cell.points``, and for its cell's loose points."""
        fresh = [other for other in cell.loose if self._count(other)]
        count = len(cell.points)
        for near in cell.near:
            if count >= self._min_samples:
                break
            count += self._within(near, self.x[point], self.y[point], self._min_samples - count)
        self._counts[point] = count
        cell.loose.append(point)
        if count >= self._min_samples:
            fresh.append(point)
        self._promote(cell, fresh)
        return fresh

    def _within(self, cell: Cell, x_um: int, y_um: int, limit: int) -> int:
        """How many points of the cell are within ε; may stop at ``limit``.

        Exact in int64: neighbours' cells bound both differences by 3·side, so the sum of squares
        is below 9·ε² ≤ 9·10¹⁸ for the largest ε that settings allow.
        """
        count = 0
        if len(cell.points) < _FEW:
            x, y, eps2 = self.x, self.y, self._eps2
            for point in cell.points:
                count += (x[point] - x_um) ** 2 + (y[point] - y_um) ** 2 <= eps2
            return count
        for start in range(0, len(cell.points), _SCAN):
            points = np.array(cell.points[start : start + _SCAN])
            dx = np.frombuffer(self.x, np.int64)[points] - x_um
            dy = np.frombuffer(self.y, np.int64)[points] - y_um
            count += int(np.count_nonzero(dx * dx + dy * dy <= self._eps2))
            if count >= limit:
                break
        return count

    def _reach_dense(self, cell: Cell, x_um: int, y_um: int) -> int | None:
        column = x_um // self._side
        if column != cell.column:
            side = 0 if column < cell.column else 1
        else:
            side = 2 if y_um < cell.row * self._side else 3
        if cell.fences is None:
            cell.fences = [None, None, None, None]
        fence = cell.fences[side]
        if fence is None:
            fence = cell.fences[side] = Fence(self._eps_um)
        for point in cell.points[fence.fed :]:
            fence.add(point, turned(side, self.x[point], self.y[point]))
        return fence.reach(turned(side, x_um, y_um))
