"""The ground: grids of positions, how likely robots are there before a crop is seen, and walls.

Walls are looked up in blocks of 8 cm or more (`projections.fold.occupancy`), at points a block
apart along a line. Both ends are left out: poses have errors, and things stand at walls.
"""

import itertools
import math
from functools import lru_cache
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.occupancy import wall_blocks

from .camera import Floats
from .constants import RankingModel

_AT_POSE_M: Final = 0.3
_AT_THING_M: Final = 0.5
_MOST_POINTS: Final = 200
"""The most points on a line; a longer one is checked in larger steps."""

Flags = NDArray[np.bool_]


class WallLookup(Protocol):
    """The interface of walls: look-ups for many positions at once."""

    def contains(self, xy: Floats) -> Flags:
        """Which positions (h, 2), in metres, are inside walls."""

    def hides(self, things: Floats, xy: Floats, asked: Flags) -> Flags:
        """Whether a wall is between a thing (n, 2) and a position (h, 2): shape (n, h), false where
        it is not ``asked``."""


class WallMap:
    """The walls of an occupancy map as a grid of blocks."""

    def __init__(self, source: OccupancyMap) -> None:
        cells, blocks = wall_blocks(source)
        self._padded = np.pad(blocks, 1)  # all around is no wall
        self._side_m = cells * source.resolution
        self._corner = np.array(source.origin[:2])
        cos, sin = math.cos(source.origin[2]), math.sin(source.origin[2])
        self._turn = np.array([[cos, -sin], [sin, cos]])

    def contains(self, xy: Floats) -> Flags:
        """Which positions (h, 2), in metres, are inside walls."""
        return self._is_wall(*self._in_blocks(xy).T)

    def hides(self, things: Floats, xy: Floats, asked: Flags) -> Flags:
        """Whether a wall is between a thing (n, 2) and a position (h, 2): shape (n, h), false where
        it is not ``asked``."""
        hidden = np.zeros(asked.shape, bool)
        rows, columns = np.nonzero(asked)
        if not len(rows):
            return hidden
        start = self._in_blocks(xy)[columns]
        way = self._in_blocks(things)[rows] - start
        length = np.sqrt((way * way).sum(axis=1))
        first, last = _AT_POSE_M / self._side_m, length - _AT_THING_M / self._side_m
        far = float(last.max())
        if far <= first:
            return hidden
        at = np.linspace(first, far, min(math.ceil(far - first) + 1, _MOST_POINTS))
        part = at[:, None] / np.maximum(length, 1.0)[None]
        met = self._is_wall(start[:, 0] + part * way[:, 0], start[:, 1] + part * way[:, 1])
        met &= at[:, None] <= last[None]
        hidden[rows, columns] = met.any(axis=0)
        return hidden

    def _in_blocks(self, xy: Floats) -> Floats:
        """Positions in blocks from the map's corner: columns and rows."""
        turned: Floats = ((xy - self._corner) @ self._turn) / self._side_m
        return turned

    def _is_wall(self, column: Floats, row: Floats) -> Flags:
        rows, columns = self._padded.shape
        down = np.clip(row + 1.0, 0.0, rows - 1.0).astype(np.intp)  # truncated, so as floor
        across = np.clip(column + 1.0, 0.0, columns - 1.0).astype(np.intp)
        found: Flags = self._padded.ravel().take(down * columns + across)
        return found


Indices = NDArray[np.intp]
Keys = NDArray[np.uint64]

_LEAST_PRIOR: Final = 1e-9


def distinct(points: Floats, grid_m: float) -> Floats:
    """The points in order, only the first of each square of a grid."""
    keys, least = _keys(np.rint(points.T / grid_m))
    keys = np.sort(keys)
    return _squares(keys.take(_first_of_each(keys)), least) * grid_m


_BITS: Final = np.uint64(27)
"""Bits of a key for y: ± 10,000 km in squares of 0.175 m. The other 37 bits are for x, in which
each floor takes 100,000 km (`floors`): some 240 floors."""


def _keys(squares: Floats) -> tuple[Keys, Floats]:
    """Keys of pairs (2, …) of whole numbers, which sort as the pairs do, and the least first and
    least second number."""
    least = squares.reshape(2, -1).min(axis=1)
    above = squares - least.reshape(2, *(1,) * (squares.ndim - 1))
    across, up = above.astype(np.int64).view(np.uint64)
    return (across << _BITS) | up, least


def _squares(keys: Keys, least: Floats) -> Floats:
    """The pairs (n, 2) that have these keys."""
    across = keys >> _BITS
    up = keys - (across << _BITS)
    return np.stack((across, up), axis=1).astype(np.float64) + least


def _first_of_each(ordered: Keys) -> Indices:
    is_new = np.ones(len(ordered), dtype=np.bool_)
    np.not_equal(ordered[1:], ordered[:-1], out=is_new[1:])
    return np.flatnonzero(is_new)


def cells_near(points: Floats, cell_m: float, reach_m: float) -> tuple[Floats, Floats]:
    """Centres of the grid cells within ``reach_m`` of a point, in order, and the squared distance
    of each to its nearest point."""
    steps, within = _steps(cell_m, reach_m)
    points = points.T[:, :, None]
    squares = np.rint(points / cell_m) + steps[:, None]
    keys, least = _keys(squares)
    keys = keys.ravel()
    dx, dy = squares * cell_m - points
    square = (dx * dx + dy * dy).ravel()
    order = np.argsort(keys)
    keys = keys.take(order)
    starts = _first_of_each(keys)
    kept = np.logical_or.reduceat(within.take(order % len(within)), starts)
    nearest = np.minimum.reduceat(square.take(order), starts)
    return _squares(keys.take(starts[kept]), least) * cell_m, nearest[kept]


@lru_cache(maxsize=8)
def _steps(cell_m: float, reach_m: float) -> tuple[Floats, Flags]:
    """Steps (2, n) from the cell of a point, and which of them are within reach. The others are
    needed because points are rounded to cells: one of them may lead to a cell that only another
    point reaches although this point is the nearest."""
    most = math.ceil((reach_m + 2.0 * cell_m) / cell_m)
    steps = np.array(list(itertools.product(range(-most, most + 1), repeat=2)), dtype=np.float64).T
    far = np.hypot(*steps) * cell_m
    near = far <= reach_m + 2.0 * cell_m
    return np.ascontiguousarray(steps[:, near]), far[near] <= reach_m + cell_m / 2


def square_to_nearest(xy: Floats, points: Floats) -> Floats:
    """The squared distance of each position to its nearest point."""
    dx = xy[:, 0, None] - points[None, :, 0]
    dy = xy[:, 1, None] - points[None, :, 1]
    dx *= dx
    dy *= dy
    dx += dy
    squared: Floats = dx.min(1)
    return squared


def log_prior(
    xy: Floats, squared: Floats, model: RankingModel, walls: WallLookup | None = None
) -> Floats:
    """The log prior of robot positions ``xy``: by the squared distance from earlier robot
    positions, and lower inside walls."""
    squared = -0.5 * squared
    near = model.driven_share * np.exp(squared / model.driven_m**2)
    far = (1.0 - model.driven_share) * np.exp(squared / model.driven_far_m**2)
    found: Floats = np.log(near + far + _LEAST_PRIOR)
    if walls is not None:
        found[walls.contains(xy)] += math.log(model.in_walls)
    return found
