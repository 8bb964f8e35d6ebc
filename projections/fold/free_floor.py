"""The free floor of an occupancy map, and which keyframe each part of it is nearest to by way.

Floor is counted in the blocks of cells on which `OccupancyGrid` computes its regions. A block is
floor if it has a free cell and no wall. A way goes from block to block, a step across a side has
length 3, one across a corner 4 (Borgefors 1986): so it is at most 8 % longer or shorter than the
straight line where that is free. It never goes through walls, nor, on a map made of scans, over
unknown ground: there that is all around, without a wall between.

Regions of the map are parted by narrow places. Of two ways the one through fewer narrow places is
the nearer, whatever their lengths: a robot that was on both sides of a door owns the floor up to
the door from each. So floor of a region that a robot was in belongs to keyframes in there. Floor of
other regions belongs to those that are at most `MOST_DOORS` narrow places and `REACH_M` of way
away; the way there is over known floor only, and from region to region across sides of blocks. Of
keyframes equally near the earliest counts. All other floor, and all unknown ground, belongs to
none.

`FreeFloor.owners` gives this for all floor; `FreeFloor.nearest` for a block of a region that a
robot was in.
"""

import heapq
from collections.abc import Container, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.occupancy_map import MIN_WALL, SCANS, OccupancyMap

from .exact import metres_to_um
from .map_regions import NOWHERE
from .occupancy import OccupancyGrid, Point, pooled

MOST_DOORS: Final = 2
REACH_M: Final = 4.0
BEHIND_M: Final = 0.4
"""A wall this far or less from a thing's estimated position, on the way to where it was seen from,
is behind the thing in truth."""
_SIDE, _CORNER = 3, 4
_SOURCE_BITS: Final = 32
_FAR: Final = 1 << 62

Block: TypeAlias = int
"""The number of a block: row by row, with a border of one block around the map."""
Owners: TypeAlias = NDArray[np.int64]
"""For each block the number of a source, or `NOWHERE`."""


class FreeFloor:
    """The floor of a map; ``shape`` is its rows and columns of blocks, with the border."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self.grid = grid
        self.side_um = grid.block * grid.side_um
        labels = np.pad(grid.inside, 1, constant_values=NOWHERE)
        self.shape: tuple[int, int] = (labels.shape[0], labels.shape[1])
        known = pooled(grid.source.cells < MIN_WALL, grid.block)
        self.is_floor = np.pad(known, 1).ravel() & (labels.ravel() != NOWHERE)
        if grid.source.source == SCANS and grid.source.map_id is None:
            labels[~self.is_floor.reshape(self.shape)] = NOWHERE
        self._labels = labels.ravel()
        self._label_of: list[int] = self._labels.tolist()
        self._floor_bytes = self.is_floor.tobytes()
        stride = self.shape[1]
        self.reach = self.steps(metres_to_um(REACH_M))
        self._sides = (1, -1, stride, -stride)
        self._steps = tuple((side, _SIDE) for side in self._sides) + tuple(
            (down + right, _CORNER) for down in (stride, -stride) for right in (1, -1)
        )

    def block_at(self, point: Point) -> Block | None:
        """The block of a position, of µm in the map frame; None outside the map."""
        column, row = self.grid.cell(point)
        column, row = column // self.grid.block + 1, row // self.grid.block + 1
        rows, columns = self.shape
        inside = 0 < row < rows - 1 and 0 < column < columns - 1
        return row * columns + column if inside else None

    def steps(self, um: int) -> int:
        """A distance as the length of a way."""
        return _SIDE * um // self.side_um

    def label(self, block: Block) -> int:
        """The region of a block, `NOWHERE` for a wall and for what no way goes over."""
        return self._label_of[block]

    def stand(self, at: Point, seen_from: Point) -> Block | None:
        """Where a thing stands: the first floor on the straight line from its estimated position to
        where it was seen from, without any before a wall within `BEHIND_M`. None if there is
        none."""
        found = None
        for block, is_behind in self._line(at, seen_from):
            if not is_behind and found is not None:
                break
            if is_behind and self._label_of[block] == NOWHERE:
                found = None
            elif found is None and self._floor_bytes[block]:
                found = block
        return found

    def entrance(self, at: Point, seen_from: Point, regions: Container[int]) -> Block | None:
        """The first floor of some regions on the straight line from a position to where it was seen
        from; None if there is none."""
        for block, _ in self._line(at, seen_from):
            if self._floor_bytes[block] and self._label_of[block] in regions:
                return block
        return None

    def _line(self, start: Point, end: Point) -> Iterator[tuple[Block, bool]]:
        """The blocks on a straight line, and whether each is within `BEHIND_M` of the start."""
        (x, y), (to_x, to_y) = start, end
        dx, dy = to_x - x, to_y - y
        far = max(abs(dx), abs(dy))
        steps = 2 * far // self.side_um + 1
        behind = min(steps, steps * metres_to_um(BEHIND_M) // max(far, 1))
        for step in range(steps + 1):
            block = self.block_at((x + dx * step // steps, y + dy * step // steps))
            if block is not None:
                yield block, step <= behind

    def nearest(self, start: Block, sources: Mapping[Block, int]) -> tuple[int, int] | None:
        """The nearest source in the region of a block, and the length of the way there; ``sources``
        are numbers by block."""
        labels, label = self._label_of, self._label_of[start]
        ways, lengths = [(0, start)], {start: 0}
        found, limit = None, _FAR
        while ways:
            length, block = heapq.heappop(ways)
            if length > limit:
                break
            if length > lengths[block]:
                continue
            source = sources.get(block)
            if source is not None:
                found, limit = source if found is None else min(found, source), length
            for step, more in self._steps:
                to, further = block + step, length + more
                if labels[to] == label and further < lengths.get(to, limit + 1):
                    lengths[to] = further
                    heapq.heappush(ways, (further, to))
        return None if found is None else (found, limit)

    def by_straight_way(
        self, start: Block, blocks: NDArray[np.int64]
    ) -> Iterator[tuple[int, bool]]:
        """Blocks as indices, those first to which a way without obstacles were shortest, of equal
        ones the first; and whether there is such a way, which stays in the region."""
        columns = self.shape[1]
        across = np.abs(blocks % columns - start % columns)
        down = np.abs(blocks // columns - start // columns)
        far, near = np.maximum(across, down), np.minimum(across, down)
        for index in np.argsort(_SIDE * (far - near) + _CORNER * near, kind="stable").tolist():
            yield index, self._is_straight_way(start, int(blocks[index]))

    def least_way(self, start: Block, end: Block) -> int:
        """The length that a way between two blocks has at least."""
        columns = self.shape[1]
        across = abs(start % columns - end % columns)
        down = abs(start // columns - end // columns)
        return _SIDE * abs(across - down) + _CORNER * min(across, down)

    def _is_straight_way(self, start: Block, end: Block) -> bool:
        """Whether one of two shortest ways stays in a region: across corners first, or sides."""
        columns, labels, label = self.shape[1], self._label_of, self._label_of[start]
        across, down = end % columns - start % columns, end // columns - start // columns
        right, up = (across > 0) - (across < 0), ((down > 0) - (down < 0)) * columns
        corners, sides = min(abs(across), abs(down)), abs(abs(across) - abs(down))
        side = right if abs(across) > abs(down) else up
        for steps in (
            ((right + up, corners), (side, sides)),
            ((side, sides), (right + up, corners)),
        ):
            block, is_free = start, True
            for step, times in steps:
                for _ in range(times):
                    block += step
                    if labels[block] != label:
                        is_free = False
                        break
                if not is_free:
                    break
            if is_free:
                return True
        return False

    def owners(self, sources: Sequence[Block]) -> Owners:
        """The nearest source of each block of floor; sources are numbered in their order."""
        blocks, first = np.unique(np.array(sources, np.int64), return_index=True)
        on_ground = self._labels[blocks] != NOWHERE
        blocks, first = blocks[on_ground], first[on_ground]
        keys = np.full(self._labels.size, _FAR, np.int64)  # length, then source
        keys[blocks] = first
        driven = np.isin(self._labels, np.unique(self._labels[blocks]))
        self._spread(keys, blocks, driven, _FAR)
        front = np.flatnonzero(keys != _FAR)
        for _ in range(MOST_DOORS):
            unowned = (keys == _FAR) & self.is_floor & ~driven
            entered = self._enter(keys, front, unowned)
            self._spread(keys, entered, unowned, self.reach)
            front = np.flatnonzero(unowned & (keys != _FAR))
        owned = self.is_floor & (keys != _FAR)
        return np.where(owned, keys & ((1 << _SOURCE_BITS) - 1), NOWHERE)

    def _enter(
        self, keys: NDArray[np.int64], front: NDArray[np.intp], unowned: NDArray[np.bool_]
    ) -> NDArray[np.intp]:
        """Go one step across a side from known floor to unowned floor of another region; returns
        the blocks entered."""
        before = keys.copy()
        for side in self._sides:
            from_ = front[self.is_floor[front]]
            to = from_ + side
            length = before[from_] + (_SIDE << _SOURCE_BITS)
            own = unowned[to] & (self._labels[to] != self._labels[from_])
            own &= length >> _SOURCE_BITS <= self.reach
            keys[to[own]] = np.minimum(keys[to[own]], length[own])
        return np.flatnonzero(unowned & (keys != _FAR))

    def _spread(
        self,
        keys: NDArray[np.int64],
        front: NDArray[np.intp],
        within: NDArray[np.bool_],
        reach: int,
    ) -> None:
        """Lower the keys of blocks ``within`` to those of the ways from the front that stay in a
        region and are within reach, until none is lower."""
        labels, is_new = self._labels, np.zeros(keys.size, np.bool_)
        while front.size:
            own, key = labels[front], keys[front]
            for step, more in self._steps:
                to, length = front + step, key + (more << _SOURCE_BITS)
                lower = (length < keys[to]) & (labels[to] == own) & within[to]
                lower &= length >> _SOURCE_BITS <= reach
                keys[to[lower]] = length[lower]
                is_new[to[lower]] = True
            front = np.flatnonzero(is_new)
            is_new[front] = False


@lru_cache(maxsize=8)
def free_floor(given: OccupancyMap) -> FreeFloor:
    """The floor of a map; kept for the maps used last, since it takes time for a large one."""
    return FreeFloor(OccupancyGrid(given))
