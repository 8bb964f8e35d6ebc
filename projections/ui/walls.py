"""The walls of an occupancy map as line segments: the outline of its occupied cells.

A straight outline is one segment. Where a map has more than `MOST_SEGMENTS`, cells are pooled: a
square of them is occupied if one of them is, so that no wall is lost.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eventsrc.occupancy_map import MIN_WALL, OCCUPIED, OccupancyMap

MOST_SEGMENTS: Final = 20_000
_Mask = NDArray[np.bool_]


@lru_cache(maxsize=8)
def wall_segments(given: OccupancyMap) -> list[list[float]]:
    """x and y of both ends, metres in the map frame, to the millimetre."""
    step = 1
    while True:
        mask = _pooled((given.cells >= MIN_WALL) & (given.cells <= OCCUPIED), step)
        ends = np.array([*_outline(mask), *(_swapped(_outline(mask.T)))]).reshape(-1, 2, 2)
        if len(ends) <= MOST_SEGMENTS:
            return _in_map_frame(given, ends * step * given.resolution)
        step *= 2


def _pooled(mask: _Mask, step: int) -> _Mask:
    rows, columns = mask.shape
    padded = np.pad(mask, ((0, -rows % step), (0, -columns % step)))
    shape = padded.shape[0] // step, step, padded.shape[1] // step, step
    return np.asarray(padded.reshape(shape).any(axis=(1, 3)))


def _outline(mask: _Mask) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """The horizontal parts of the outline, as (column, row) of corners of cells."""
    framed = np.pad(mask, ((1, 1), (0, 0)))
    edges = np.pad(framed[1:] != framed[:-1], ((0, 0), (1, 1)))
    turns = edges[:, 1:] != edges[:, :-1]
    rows, columns = np.nonzero(turns)
    for index in range(0, len(rows), 2):  # the turns of a row come in pairs: begin and end
        row = int(rows[index])
        yield (int(columns[index]), row), (int(columns[index + 1]), row)


def _swapped(
    ends: Iterator[tuple[tuple[int, int], tuple[int, int]]],
) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    return (((b, a), (d, c)) for (a, b), (c, d) in ends)


def _in_map_frame(given: OccupancyMap, ends: NDArray[Any]) -> list[list[float]]:
    x, y, yaw = given.origin
    cos, sin = np.cos(yaw), np.sin(yaw)
    u, v = ends[..., 0], ends[..., 1]
    placed = np.stack([x + cos * u - sin * v, y + sin * u + cos * v], axis=-1)
    found: list[list[float]] = np.round(placed.reshape(-1, 4), 3).tolist()
    return found
