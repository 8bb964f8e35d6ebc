"""An occupancy map as the fold uses it: walls, and which poses may be neighbours.

Everything is in integers, so that it is the same on every machine. Micrometres of the map frame are
turned and shifted into the grid's own frame (cosine and sine as multiples of 2⁻³⁰, rounded down);
there a cell is a half-open square, and a line's cells are the cells of its points.

`passable` is the rule of ``places = "rooms"``: the straight line between two poses meets no wall,
and both ends are in one region, so that no narrow place lies
between. Of a pose outside the grid only walls on the line are known. A pose may lie in a wall
because of its error: walls that a line begins or ends in do not count, and a wall cell is of the
region around it.

Unknown cells and everything outside the grid are no walls. Nor are small ones, such as legs of
furniture.

*Regions* are areas without a narrow place inside (`map_regions`).
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.occupancy_map import MIN_WALL, OCCUPIED, OccupancyMap

from .exact import UM_PER_M, cos_sin, distance_um, metres_to_um
from .map_regions import NOWHERE, Labels, Walls, clearance, clearance_cap, regions

LEAST_WALL_M: Final = 0.5
"""Connected wall cells that are shorter than this in x and in y are no wall."""
LEAST_BLOCK_M: Final = 0.08
MAX_BLOCKS: Final = 400_000
"""The most blocks of a map. Regions are computed on blocks of cells with a side of at least
``LEAST_BLOCK_M``, larger if there would be more blocks: this bounds the time, half a microsecond a
block."""
SMALL_M2: Final = 110
SMALL_SHARE: Final = 4
"""Largest region, in square metres, that counts as one room: a way in it counts as a quarter. Both
were chosen on buildings with walls; docs/places.md has the figures."""
CORRIDOR_M: Final = 4
"""A larger region counts as one, too, if its floor is as near to walls as that of a corridor this
wide: in the mean of squares a twelfth of its square."""
_SPREAD: Final = 5
"""Depth in blocks to which the cells of a wall are of the region beside it."""
_TURN_BITS: Final = 30

Point = tuple[int, int]
"""x and y in micrometres."""


class OccupancyGrid:
    """The walls and regions of a map."""

    def __init__(self, source: OccupancyMap) -> None:
        self.source = source
        self.side_um = metres_to_um(source.resolution)
        self._x0, self._y0 = (metres_to_um(metres) for metres in source.origin[:2])
        cos, sin = cos_sin(source.origin[2])
        self._cos, self._sin = (round(math.ldexp(part, _TURN_BITS)) for part in (cos, sin))
        walls = occupied(source)
        self.block, kept = wall_blocks(source)
        block_m = self.block * source.resolution
        self.walls = walls & _cells(kept, self.block, walls.shape)
        self._rows = [row.tobytes() for row in self.walls.astype(np.uint8)]
        near = clearance(kept, clearance_cap(block_m))
        self.inside: Labels = regions(near, block_m)
        """The region of each block, `NOWHERE` for those with a wall."""
        self._small = _small_regions(self.inside, near, self.block * self.side_um)
        self.regions: Labels = _spread(self.inside, _SPREAD)

    def cell(self, point: Point) -> tuple[int, int]:
        """Column and row of a point; they may lie outside the grid."""
        u, v = self._to_grid(point)
        return u // self.side_um, v // self.side_um

    def in_map(self, column: int, row: int) -> Point:
        """The position of the lower left corner of a cell in the map frame, µm."""
        u, v = column * self.side_um, row * self.side_um
        x = (u * self._cos - v * self._sin) >> _TURN_BITS
        y = (u * self._sin + v * self._cos) >> _TURN_BITS
        return x + self._x0, y + self._y0

    def is_wall(self, point: Point) -> bool:
        """Whether a point lies in a wall."""
        return self._has_wall(self._to_grid(point))

    def region(self, point: Point) -> int | None:
        """The region that a point is in, `NOWHERE` for one deep in a wall; None outside the
        grid."""
        column, row = self.cell(point)
        rows, columns = self.walls.shape
        if not (0 <= row < rows and 0 <= column < columns):
            return None
        return int(self.regions[row // self.block, column // self.block])

    def passable(self, a: Point, b: Point) -> bool:
        """Whether two poses may be neighbours; symmetric."""
        return self.straight_way_um(a, b) is not None

    def straight_way_um(self, a: Point, b: Point) -> int | None:
        """The length of the straight way between two poses for ``places = "rooms"``; None where
        they are not `passable`. A way in a region as small as a room counts less."""
        start, end = self.region(a), self.region(b)
        is_within = start is not None and end is not None
        if (is_within and start != end) or not self.is_free_line(a, b):
            return None
        length = distance_um(*a, *b)
        return length // SMALL_SHARE if is_within and start in self._small else length

    def is_free_line(self, a: Point, b: Point) -> bool:
        """Whether the line from a to b meets no wall but those that it begins and ends in."""
        start, end = sorted((self._to_grid(a), self._to_grid(b)), key=lambda p: (p[1], p[0]))
        line, rows = self._line(start, end), self._rows
        if all(rows[row].find(1, first, last + 1) < 0 for row, first, last in line):
            return True
        starts_in_wall, ends_in_wall = self._has_wall(start), self._has_wall(end)
        if not (starts_in_wall or ends_in_wall):
            return False
        met = bytearray()
        for row, first, last in line:
            cells = rows[row][first : last + 1]
            met += cells if end[0] >= start[0] else cells[::-1]
        if starts_in_wall:
            met = met.lstrip(b"\x01")
        if ends_in_wall:
            met = met.rstrip(b"\x01")
        return 1 not in met

    def _has_wall(self, at: Point) -> bool:
        """Whether the cell of a point of the grid's frame is wall."""
        column, row = at[0] // self.side_um, at[1] // self.side_um
        rows, columns = self.walls.shape
        return 0 <= row < rows and 0 <= column < columns and bool(self.walls[row, column])

    def _to_grid(self, point: Point) -> Point:
        """A point in the grid's own frame: µm from its corner along rows and across them."""
        dx, dy = point[0] - self._x0, point[1] - self._y0
        if not self._sin and self._cos > 0:
            return dx, dy
        u, v = dx * self._cos + dy * self._sin, dy * self._cos - dx * self._sin
        return u >> _TURN_BITS, v >> _TURN_BITS

    def _line(self, start: Point, end: Point) -> list[tuple[int, int, int]]:
        """Row, first and last column of the cells of a line within the grid, row by row from the
        start, which is not above the end."""
        side, (rows, columns) = self.side_um, self.walls.shape
        (ax, ay), (bx, by) = start, end
        dx, dy = bx - ax, by - ay
        found = []
        for row in range(max(ay // side, 0), min(by // side, rows - 1) + 1):
            if row == by // side:  # ends in this row
                left_at, right_at = bx // side, bx // side
            else:  # leaves it through its upper edge, which is the next row's
                across = ax * dy + dx * ((row + 1) * side - ay)
                left_at = across // (dy * side)
                right_at = (across - (dx > 0)) // (dy * side)
            if row == ay // side:
                enters = ax // side
            else:
                enters = (ax * dy + dx * (row * side - ay)) // (dy * side)
            first, last = max(min(enters, left_at), 0), min(max(enters, right_at), columns - 1)
            if first <= last:
                found.append((row, first, last))
        return found


def wall_blocks(source: OccupancyMap) -> tuple[int, Walls]:
    """The number of cells in the side of a block, and the blocks of a map that have a wall."""
    side = _block_side(source)
    blocks = pooled(occupied(source), side)
    least = max(1, math.ceil(LEAST_WALL_M / (side * source.resolution)))
    return side, _without_small(blocks, least)


def occupied(source: OccupancyMap) -> Walls:
    """The cells of a map that are wall, small ones too."""
    return np.asarray((source.cells >= MIN_WALL) & (source.cells <= OCCUPIED))


def _block_side(source: OccupancyMap) -> int:
    """Cells in the side of a block."""
    side = max(1, math.ceil(LEAST_BLOCK_M / source.resolution))
    while -(-source.width // side) * -(-source.height // side) > MAX_BLOCKS:
        side += 1
    return side


def pooled(mask: Walls, side: int) -> Walls:
    """A block for each square of ``side`` by ``side`` cells: true where any of them is."""
    rows, columns = mask.shape
    padded = np.pad(mask, ((0, -rows % side), (0, -columns % side)))
    by_block = padded.reshape(padded.shape[0] // side, side, padded.shape[1] // side, side)
    return np.asarray(by_block.any(axis=(1, 3)))


def _cells(blocks: Walls, side: int, shape: tuple[int, ...]) -> Walls:
    """The value of each cell: that of its block."""
    cells: Walls = blocks.repeat(side, axis=0).repeat(side, axis=1)[: shape[0], : shape[1]]
    return cells


def _without_small(walls: Walls, least: int) -> Walls:
    """The walls without connected ones of fewer than ``least`` rows and columns; cells that touch
    at a corner are connected."""
    rows, columns = walls.shape
    cells = np.flatnonzero(np.pad(walls, 1))
    numbers = np.full((rows + 2) * (columns + 2), len(cells), np.int64)
    numbers[cells] = np.arange(len(cells))
    stride = columns + 2
    steps = (1, stride - 1, stride, stride + 1)
    beside = [numbers[cells + step] for step in (*steps, *(-step for step in steps))]
    first = np.arange(len(cells) + 1)  # the lowest number known of each wall's cells
    while True:
        lower = first.copy()
        for each in beside:
            np.minimum(lower[:-1], first[each], out=lower[:-1])
        lower = lower[lower]
        if np.array_equal(lower, first):
            break
        first = lower
    kept = walls.copy()
    row, column, wall = cells // stride - 1, cells % stride - 1, first[:-1]
    is_small = np.ones(len(cells), np.bool_)
    for at in (row, column):
        ends = np.full(len(cells), len(numbers)), np.full(len(cells), -1)
        np.minimum.at(ends[0], wall, at)
        np.maximum.at(ends[1], wall, at)
        is_small &= (ends[1] - ends[0])[wall] < least
    kept[row[is_small], column[is_small]] = False
    return kept


def _small_regions(labels: Labels, near: NDArray[np.int32], side_um: int) -> frozenset[int]:
    """The regions of at most ``SMALL_M2`` and corridors, of blocks with sides of ``side_um`` and
    their clearance."""
    inside = labels != NOWHERE
    sizes = np.bincount(labels[inside]).tolist()
    sums = np.bincount(labels[inside], near[inside]).tolist()  # exact: integers
    most_um2, side_um2 = SMALL_M2 * UM_PER_M * UM_PER_M, side_um * side_um
    wide_um2 = CORRIDOR_M * CORRIDOR_M * UM_PER_M * UM_PER_M
    return frozenset(
        region
        for region, (size, total) in enumerate(zip(sizes, sums, strict=True))
        if size * side_um2 <= most_um2 or 12 * int(total) * side_um2 <= size * wide_um2
    )


def _spread(labels: Labels, steps: int) -> Labels:
    """Give cells without a region that of a neighbour, ``steps`` times; neighbours in the order of
    `_BESIDE`."""
    padded = np.pad(labels, 1, constant_values=NOWHERE)
    flat, stride = padded.ravel(), padded.shape[1]
    missing = np.flatnonzero(np.pad(labels == NOWHERE, 1))
    for _ in range(steps):
        found = np.full(len(missing), NOWHERE, np.int32)
        for down, right in _BESIDE:
            beside = flat[missing + down * stride + right]
            np.copyto(found, beside, where=found == NOWHERE)
        flat[missing] = found
        missing = missing[found == NOWHERE]
    return padded[1:-1, 1:-1].copy()


_BESIDE: Final = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
