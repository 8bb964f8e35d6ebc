"""The nearest keyframe of floor by way, against a search over the cells one by one."""

import heapq
import math
from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from eventsrc.envelope.occupancy_map import UNKNOWN, OccupancyMap
from projections.fold.free_floor import MOST_DOORS, REACH_M, FreeFloor
from projections.fold.map_regions import NOWHERE
from projections.fold.occupancy import OccupancyGrid
from projections.map.place_regions import outlines
from tests.support.thorough import examples

RESOLUTION = 0.2
SIDE, CORNER = 3, 4
Cell = tuple[int, int]


@st.composite
def grounds(draw: st.DrawFn) -> tuple[OccupancyMap, list[tuple[float, float]]]:
    """A map of rooms with doors, noise and a turned origin, and poses, some of them outside."""
    chance = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    height, width = chance.integers(1, 40, 2)
    cells = np.zeros((height, width), np.uint8)
    for _ in range(chance.integers(0, 5)):
        if chance.random() < 0.5:
            cells[chance.integers(0, height)] = 100
        else:
            cells[:, chance.integers(0, width)] = 100
    for _ in range(chance.integers(0, 8)):
        row, column = chance.integers(0, height), chance.integers(0, width)
        cells[row : row + 3, column : column + 3] = chance.choice([0, 0, UNKNOWN])
    origin = (*chance.uniform(-5, 5, 2).tolist(), float(chance.choice([0.0, 0.7, -2.0])))
    at = chance.uniform(-1, 1 + max(width, height), (chance.integers(0, 8), 2)) * RESOLUTION
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    poses = [(origin[0] + u * cos - v * sin, origin[1] + u * sin + v * cos) for u, v in at]
    return OccupancyMap(None, RESOLUTION, origin, "test", cells), poses


def naive_owners(grid: OccupancyGrid, sources: Sequence[Cell]) -> dict[Cell, int]:
    """By (narrow places, length, source): a search of all ways at once, over cells."""
    labels = {
        (row, column): int(label)
        for (row, column), label in np.ndenumerate(grid.inside)
        if label != NOWHERE
    }
    known = {cell for cell in labels if grid.source.cells[cell] < 65}
    driven = {labels[cell] for cell in sources if cell in labels}
    reach = SIDE * round(REACH_M * 1e6) // grid.side_um
    ways = [(0, 0, number, cell) for number, cell in enumerate(sources) if cell in labels]
    heapq.heapify(ways)
    owners: dict[Cell, int] = {}
    while ways:
        doors, length, number, cell = heapq.heappop(ways)
        if cell in owners:
            continue
        owners[cell] = number
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                to = cell[0] + down, cell[1] + right
                if to not in labels:
                    continue
                more = length + (CORNER if down and right else SIDE)
                if labels[to] == labels[cell]:
                    if labels[to] in driven or (to in known and more <= reach):
                        heapq.heappush(ways, (doors, more, number, to))
                elif (
                    not (down and right)
                    and labels[to] not in driven
                    and doors < MOST_DOORS
                    and {to, cell} <= known
                    and more <= reach
                ):
                    heapq.heappush(ways, (doors + 1, more, number, to))
    return {cell: number for cell, number in owners.items() if cell in known}


@settings(max_examples=examples(60), deadline=None)
@given(grounds())
def test_all_floor_belongs_to_the_nearest_keyframe_by_way(
    made: tuple[OccupancyMap, list[tuple[float, float]]],
) -> None:
    source, poses = made
    grid = OccupancyGrid(source)
    floor = FreeFloor(grid)
    assert grid.block == 1
    points = [(round(x * 1e6), round(y * 1e6)) for x, y in poses]
    blocks = [block for point in points if (block := floor.block_at(point)) is not None]
    columns = floor.shape[1]
    cells = [(block // columns - 1, block % columns - 1) for block in blocks]
    assert cells == [
        (row, column)
        for column, row in map(grid.cell, points)
        if 0 <= row < source.height and 0 <= column < source.width
    ]
    owners = floor.owners(blocks).reshape(floor.shape)[1:-1, 1:-1]
    found = {(r, c): int(n) for (r, c), n in np.ndenumerate(owners) if n != NOWHERE}
    assert found == naive_owners(grid, cells)
    _check_one_by_one(floor, blocks, owners)


def _check_one_by_one(floor: FreeFloor, blocks: list[int], owners: NDArray[np.int64]) -> None:
    """`nearest` and `by_straight_way`, of floor in regions that have a source."""
    numbers: dict[int, int] = {}
    for number, block in enumerate(blocks):
        if floor.label(block) != NOWHERE:
            numbers.setdefault(block, number)
    for (row, column), owner in np.ndenumerate(owners):
        block = (row + 1) * floor.shape[1] + column + 1
        label = floor.label(block)
        own = {b: n for b, n in numbers.items() if floor.label(b) == label}
        if owner == NOWHERE or not own:
            continue
        nearest = floor.nearest(block, own)
        assert nearest is not None
        assert nearest[0] == owner
        assert min(floor.least_way(block, each) for each in own) <= nearest[1]
        before = list[int]()
        for index, is_free in floor.by_straight_way(block, np.array(list(own), np.int64)):
            before.append(list(own.values())[index])
            if is_free:
                break
        assert owner in before or not is_free


@settings(max_examples=examples(100), deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_outlines_enclose_the_blocks_and_touch_in_points_only(seed: int) -> None:
    chance = np.random.default_rng(seed)
    mask = chance.random(chance.integers(1, 12, 2)) < chance.random()
    parts = outlines(mask)
    edges = set[tuple[Cell, Cell]]()
    inside = np.zeros(mask.shape, np.int64)
    for rings in parts:
        for number, ring in enumerate(rings):
            ends = list(zip(ring, ring[1:] + ring[:1], strict=True))
            area = sum(ax * by - bx * ay for (ax, ay), (bx, by) in ends)
            assert (area > 0) == (number == 0), "only the first ring is counter-clockwise"
            assert len(set(ring)) == len(ring)
            for (ax, ay), (bx, by) in ends:
                assert (ax == bx) != (ay == by)
                step = (bx > ax) - (bx < ax), (by > ay) - (by < ay)
                for i in range(abs(bx - ax) + abs(by - ay)):
                    edge = ((ax + i * step[0], ay + i * step[1]), step)
                    assert edge not in edges
                    edges.add(edge)
                if ax == bx:  # all blocks to the right of it are once more inside, or once less
                    inside[min(ay, by) : max(ay, by), ax:] += 1 if by < ay else -1
    assert (inside == mask).all()
