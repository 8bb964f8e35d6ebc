"""The walls of an occupancy map as line segments: the outline of its occupied cells.

A straight outline is one segment. Where a map has more than `MOST_SEGMENTS`, cells are pooled: a
square of them is occupied if one of them is, so that no wall is lost.
"""

from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.occupancy import occupied, pooled

MOST_SEGMENTS: Final = 20_000
_Mask = NDArray[np.bool_]


@lru_cache(maxsize=8)
def wall_segments(given: OccupancyMap) -> list[list[float]]:
    """The segments: x and y of both ends, in metres in the map frame, to the millimetre."""
    walls = occupied(given)
    step = 1
    while True:
        mask = pooled(walls, step)
        across, along = _turns(mask), _turns(mask.T)
        # A segment has two turns. They are counted first: a noisy map has millions of segments.
        if np.count_nonzero(across) + np.count_nonzero(along) <= 2 * MOST_SEGMENTS:
            ends = np.concatenate([_segments(across), _segments(along)[..., ::-1]])
            return _in_map_frame(given, ends * step * given.resolution)
        step *= 2


def _turns(mask: _Mask) -> _Mask:
    """The corners of cells at which horizontal parts of the outline begin or end."""
    framed = np.pad(mask, ((1, 1), (0, 0)))
    edges = np.pad(framed[1:] != framed[:-1], ((0, 0), (1, 1)))
    return np.asarray(edges[:, 1:] != edges[:, :-1])


def _segments(turns: _Mask) -> NDArray[np.intp]:
    """(column, row) of both ends of each; the turns of a row come in pairs, begin and end."""
    rows, columns = np.nonzero(turns)
    return np.stack([columns, rows], axis=-1).reshape(-1, 2, 2)


def _in_map_frame(given: OccupancyMap, ends: NDArray[Any]) -> list[list[float]]:
    x, y, yaw = given.origin
    cos, sin = np.cos(yaw), np.sin(yaw)
    u, v = ends[..., 0], ends[..., 1]
    placed = np.stack([x + cos * u - sin * v, y + sin * u + cos * v], axis=-1)
    found: list[list[float]] = np.round(placed.reshape(-1, 4), 3).tolist()
    return found
