"""Walls from the robots' own range scans, where no map of the floor is given.

1.  A floor's grid has cells of `CELL_UM` with odds from -`MOST` to `MOST`; 0 is unknown. A beam
    adds `HIT` to the cell that it ends in, and `PASSED` to each before whose middle is nearer to
    it than to its neighbours, but at most `WIDEST` off; it is followed for `REACH_M`. A beam
    without an end crosses cells only.
2.  A cell is wall from `WALL` on, free below 0.
3.  A map is made of the grid when a quarter more cells are known than at the last one, and when
    twice as many scans were cast: so all maps cost a few times what the last one does.

The pose is the corrected one. Directions are multiples of 2⁻¹³ turns, ends of beams multiples of
2⁻¹⁶ cells, and for the cells crossed the sensor is at one of `_PARTS`² points of its cell: integers
from there on. A scan that would make a side of the grid longer than
`MOST_CELLS` is left out, so that no map has more cells than one may have. If more are left out in a
row than the grid has scans, at most `FIRST_DOUBLING`, the grid is discarded and the last of them
starts a new one: the first poses of a robot may be wrong, before it is localised.
"""

import math
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import NO_RETURN_MM, UNKNOWN_MM, StatedScan
from eventsrc.envelope.occupancy_map import OCCUPIED, SCANS, UNKNOWN, OccupancyMap

from . import State, part, prefixed
from .deltas import Pose
from .exact import UM_PER_M, cos_sin, metres_to_um
from .sights import small_angle

CELL_UM: Final = 100_000
CELL_MM: Final = 100
REACH_M: Final = 8
PASSED, HIT, MOST, WALL = -2, 5, 40, 5
MOST_CELLS: Final = 3968
LEAST_NEWS: Final = 100
SHARE_OF_NEWS: Final = 4
FIRST_DOUBLING: Final = 32
_DIRECTIONS: Final = 1 << 13
_TURN: Final = 6.283185307179586
_BITS: Final = 16
_STEPS: Final = REACH_M * UM_PER_M // CELL_UM
_HALF: Final = _STEPS + 2
"""Cells from the sensor's to the border of the window that a scan changes."""
_GROWN_BY: Final = 64
_PARTS: Final = 4
_SECTORS: Final = 1 << 11
WIDEST: Final = 4
"""Sectors: at `REACH_M` one cell."""
_FARTHER_MM: Final = 2**15 - 1
"""More than `REACH_M`."""

Odds: TypeAlias = NDArray[np.int8]


@lru_cache(maxsize=1)
def _directions() -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Cosine and sine of each direction, multiples of 2⁻¹⁶."""
    parts = [cos_sin(number * (_TURN / _DIRECTIONS)) for number in range(_DIRECTIONS)]
    scaled = np.rint(np.array(parts) * (1 << _BITS)).astype(np.int32)
    return scaled[:, 0].copy(), scaled[:, 1].copy()


@lru_cache(maxsize=_PARTS * _PARTS)
def _around(x: int, y: int) -> tuple[NDArray[np.intp], NDArray[np.int16]]:
    """Sector and distance (mm) of the middles of a window's cells from a sensor in its middle
    cell, in one of the parts of that."""
    side = np.arange(-_HALF, _HALF + 1) * 2 * _PARTS + _PARTS
    dx, dy = side - (2 * x + 1), (side - (2 * y + 1))[:, None]
    each = _DIRECTIONS // _SECTORS
    cosines, sines = (part[::each].astype(np.int64) for part in _directions())
    roughly = np.rint(np.arctan2(dy, dx) * (_SECTORS / _TURN)).astype(np.int64)
    near = (roughly + np.array([-1, 0, 1])[:, None, None]) & (_SECTORS - 1)
    off = np.abs(dx * sines[near] - dy * cosines[near])  # exact, which the arc tangent is not
    nearest = np.take_along_axis(near, off.argmin(axis=0)[None], axis=0)[0]
    far = np.sqrt((dx * dx + dy * dy) * CELL_MM**2) / (2 * _PARTS)
    return nearest.astype(np.intp), np.minimum(far, 1000 * REACH_M).astype(np.int16)


class ScannedFloor:
    """The grid of one floor. ``column`` and ``row`` are those of its first cell."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self.column = self.row = 0
        self.odds: Odds = np.zeros((0, 0), np.int8)
        self.scans = self.scans_at_map = 0
        self.news = self.known = 0
        self.left_out = 0  # in a row

    def cast(self, pose: Pose, scan: StatedScan) -> bool:
        """Add a scan taken at a pose of the robot; False if it is left out, too far away."""
        yaw = small_angle(pose.yaw_rad)
        cos, sin = cos_sin(yaw)
        x_um = pose.x_um + metres_to_um(cos * scan.x - sin * scan.y)
        y_um = pose.y_um + metres_to_um(sin * scan.x + cos * scan.y)
        column, row = x_um // CELL_UM, y_um // CELL_UM
        if not self._has_room(column, row):
            self.left_out += 1
            if self.left_out <= self.scans or self.scans > FIRST_DOUBLING:
                return False
            self._begin()
            self._has_room(column, row)
        self.left_out = 0
        ranges = scan.ranges()
        angles = (yaw + scan.yaw + scan.angle_min) + np.arange(len(ranges)) * scan.angle_step
        numbers = np.rint(angles * (_DIRECTIONS / _TURN)).astype(np.int64) & (_DIRECTIONS - 1)
        cosines, sines = (part[numbers] for part in _directions())
        left, below = column - _HALF, row - _HALF
        ax, ay = (
            ((at - first * CELL_UM) << _BITS) // CELL_UM
            for at, first in ((x_um, left), (y_um, below))
        )
        most = int(min(REACH_M, scan.range_max) * 1000)
        seen = np.minimum(np.where(ranges == NO_RETURN_MM, most, ranges), REACH_M * 1000)
        known = ranges != UNKNOWN_MM
        half = math.ceil(min(abs(scan.angle_step) * (_SECTORS / _TURN) / 2, WIDEST))
        # By the beam that is nearest to each sector, of several the shortest.
        free_mm = np.zeros(_SECTORS, np.int16)
        sectors = (numbers * _SECTORS + _DIRECTIONS // 2) // _DIRECTIONS
        for beside in sorted(range(-half, half + 1), key=abs, reverse=True):
            found = (sectors + beside) & (_SECTORS - 1)
            free_mm[found] = _FARTHER_MM
            np.minimum.at(free_mm, found[known], (seen[known] - CELL_MM).astype(np.int16))
        free_mm[free_mm == _FARTHER_MM] = 0  # of beams that say nothing
        parts = (at * _PARTS // CELL_UM % _PARTS for at in (x_um, y_um))
        sector, far_mm = _around(*parts)
        touched = PASSED * (far_mm <= free_mm.take(sector, mode="wrap")).view(np.int8)
        flat = touched.ravel()
        ends = known & (ranges < REACH_M * 1000) & (ranges != NO_RETURN_MM)
        far = ranges[ends].astype(np.int64)
        columns = (ax + cosines[ends] * far // CELL_MM) >> _BITS
        rows = (ay + sines[ends] * far // CELL_MM) >> _BITS
        flat[rows * touched.shape[1] + columns] = HIT
        self._add(left, below, touched)
        return True

    def _has_room(self, column: int, row: int) -> bool:
        """Make the grid large enough for a scan from a cell; False if that is too large."""
        first = [(at - _HALF) // _GROWN_BY * _GROWN_BY for at in (column, row)]
        end = [-(-(at + _HALF + 1) // _GROWN_BY) * _GROWN_BY for at in (column, row)]
        if self.odds.size:
            rows, columns = self.odds.shape
            first = [min(a, b) for a, b in zip(first, (self.column, self.row), strict=True)]
            ends = self.column + columns, self.row + rows
            end = [max(a, b) for a, b in zip(end, ends, strict=True)]
        width, height = end[0] - first[0], end[1] - first[1]
        if max(width, height) > MOST_CELLS:
            return False
        if (height, width) != self.odds.shape:
            grown = np.zeros((height, width), np.int8)
            rows, columns = self.odds.shape
            down, right = (self.row - first[1], self.column - first[0]) if rows else (0, 0)
            grown[down : down + rows, right : right + columns] = self.odds
            self.odds, (self.column, self.row) = grown, first
        return True

    def _add(self, left: int, below: int, touched: Odds) -> None:
        right, down = left - self.column, below - self.row
        window = self.odds[down : down + touched.shape[0], right : right + touched.shape[1]]
        self.news += int(np.count_nonzero((window == 0) & (touched != 0)))
        window[:] = np.clip(window + touched, -MOST, MOST)  # quicker than into the window
        self.scans += 1

    def is_due(self) -> bool:
        """Whether a map is to be made."""
        return self.news >= max(LEAST_NEWS, self.known // SHARE_OF_NEWS) or (
            self.scans >= 2 * max(self.scans_at_map, FIRST_DOUBLING) and bool(self.odds.any())
        )

    def map(self, floor: str | None) -> OccupancyMap:
        """The grid as an occupancy map, from its first to its last known row and column."""
        known = self.odds != 0
        self.scans_at_map, self.news, self.known = self.scans, 0, int(np.count_nonzero(known))
        rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
        kept = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        odds = self.odds[kept]
        cells = np.where(odds >= WALL, OCCUPIED, np.where(odds < 0, 0, UNKNOWN)).astype(np.uint8)
        x, y = self.column + int(columns[0]), self.row + int(rows[0])
        origin = x * CELL_UM / UM_PER_M, y * CELL_UM / UM_PER_M, 0.0
        return OccupancyMap(None, CELL_UM / UM_PER_M, origin, SCANS, cells, floor)


_NUMBERS: Final = ("column", "row", "scans", "scans_at_map", "news", "known", "left_out")


class Scans:
    """The grids by number of their floor."""

    def __init__(self) -> None:
        self._floors: dict[int, ScannedFloor] = {}

    def add(
        self, number: int, floor: str | None, pose: Pose, scan: StatedScan
    ) -> OccupancyMap | bool:
        """Cast a scan; returns a new map if one is due, False if the scan is left out."""
        grid = self._floors.setdefault(number, ScannedFloor())
        is_cast = grid.cast(pose, scan)
        return grid.map(floor) if grid.is_due() else is_cast

    def forget(self, number: int) -> None:
        """Drop the grid of a floor."""
        self._floors.pop(number, None)

    def dump(self) -> State:
        """The whole state, to be kept; nothing without a scan."""
        if not self._floors:
            return {}
        state: State = {"floors": list(self._floors)}
        for number, grid in self._floors.items():
            fields = {name: getattr(grid, name) for name in _NUMBERS}
            state |= prefixed(str(number), fields | {"odds": grid.odds})
        return state

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        for number in state.get("floors", ()):
            grid = self._floors[number] = ScannedFloor()
            fields = part(str(number), state)
            for name in _NUMBERS:
                setattr(grid, name, fields[name])
            grid.odds = np.array(fields["odds"], np.int8)
