"""The walls of the occupancy map in re-localisation: poses inside them, and lines of sight.

Walls are looked up in blocks of 8 cm or more (`projections.fold.occupancy`), at points a block
apart along a line. Both ends are left out: poses have errors, and things stand at walls.
"""

import math
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.occupancy import wall_blocks

from .camera import Floats

_AT_POSE_M: Final = 0.3
_AT_THING_M: Final = 0.5
_MOST_POINTS: Final = 200
"""The most points on a line; a longer one is checked in larger steps."""

Flags = NDArray[np.bool_]


class Walls(Protocol):
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
