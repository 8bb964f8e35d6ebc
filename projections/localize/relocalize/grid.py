"""Grids of positions, and how likely robots are there before any crop is seen."""

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .camera import Floats
from .landmarks import Landmarks
from .model import Model
from .walls import Walls

Indices = NDArray[np.intp]
Keys = NDArray[np.uint64]
Flags = NDArray[np.bool_]

_LEAST_PRIOR: Final = 1e-9
_LANDMARKS, _LEAST_LANDMARKS = 48, 3
_MOST_SPOTS: Final = 600


def likely_spots(marks: Sequence[Landmarks], grid_m: float) -> Floats:
    """Positions from which a landmark was seen, one for each square of a grid, at most
    `_MOST_SPOTS`. With many crops, only the landmarks that look most like each crop are used, which
    bounds the cost of a question with many views."""
    most = max(_LEAST_LANDMARKS, _LANDMARKS // len(marks))
    found = []
    for each in marks:
        looks = each.ratios.max(1)
        chosen = np.argsort(-looks, kind="stable")
        ends = np.append(each.starts[1:], len(each.seen_from))
        for rank, landmark in enumerate(chosen.tolist()):
            if rank < most or looks[landmark] == looks[chosen[0]]:
                found.append(each.seen_from[each.starts[landmark] : ends[landmark]])
    spots = distinct(np.concatenate(found), grid_m)
    return spots[:: -(-len(spots) // _MOST_SPOTS)]


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
    squared: Floats = (dx * dx + dy * dy).min(1)
    return squared


def log_prior(xy: Floats, squared: Floats, model: Model, walls: Walls | None = None) -> Floats:
    """The log prior of robot positions ``xy``: by the squared distance from earlier robot
    positions, and lower inside walls."""
    squared = -0.5 * squared
    near = model.driven_share * np.exp(squared / model.driven_m**2)
    far = (1.0 - model.driven_share) * np.exp(squared / model.driven_far_m**2)
    found: Floats = np.log(near + far + _LEAST_PRIOR)
    if walls is not None:
        found[walls.contains(xy)] += math.log(model.in_walls)
    return found
