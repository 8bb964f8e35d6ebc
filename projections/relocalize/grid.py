"""Grids of positions, and how likely robots are there before any crop is seen."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from .camera import Floats
from .landmarks import Landmarks
from .model import Model
from .walls import Walls

_LEAST_PRIOR: Final = 1e-9
_LANDMARKS, _LEAST_LANDMARKS = 48, 3
_MOST_SPOTS: Final = 600


def likely_spots(marks: Sequence[Landmarks], grid_m: float) -> Floats:
    """Positions that saw a landmark, those in one square of a grid once: of all landmarks, or with
    many crops of each crop's best by looks, so that a question of many views costs no more for each
    of them. There are at most `_MOST_SPOTS`."""
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
    """The points, those in one square of a grid once."""
    return _unique(np.rint(points / grid_m)) * grid_m


def _unique(cells: Floats) -> Floats:
    """Each pair of whole numbers once, in order."""
    pairs = np.unique(np.ascontiguousarray(cells).view(np.complex128))
    return np.column_stack((pairs.real, pairs.imag))


def cells_near(points: Floats, cell_m: float, reach_m: float) -> Floats:
    """Middles of the cells of a grid within reach of a point."""
    most = math.ceil(reach_m / cell_m)
    steps = np.array(
        [
            (x, y)
            for x in range(-most, most + 1)
            for y in range(-most, most + 1)
            if math.hypot(x, y) * cell_m <= reach_m + cell_m / 2
        ],
        dtype=np.float64,
    )
    cells = np.rint(points / cell_m)
    return _unique((cells[:, None] + steps[None]).reshape(-1, 2)) * cell_m


def log_prior(xy: Floats, been: Floats, model: Model, walls: Walls | None = None) -> Floats:
    """How likely a robot is there: by the distance from where robots have been; inside a wall less
    so."""
    dx = xy[:, 0, None] - been[None, :, 0]
    dy = xy[:, 1, None] - been[None, :, 1]
    squared = -0.5 * (dx * dx + dy * dy).min(1)
    near = model.driven_share * np.exp(squared / model.driven_m**2)
    far = (1.0 - model.driven_share) * np.exp(squared / model.driven_far_m**2)
    found: Floats = np.log(near + far + _LEAST_PRIOR)
    if walls is not None:
        found[walls.contains(xy)] += math.log(model.in_walls)
    return found
