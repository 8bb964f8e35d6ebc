"""Walls of occupancy maps as segments, against the cells one by one."""

import math
import tracemalloc

import numpy as np
import pytest

from eventsrc.envelope.occupancy_map import UNKNOWN, OccupancyMap
from projections.map.place_regions import MOST_SEGMENTS, wall_segments
from tests.support.thorough import stride


def given(cells: np.ndarray, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> OccupancyMap:
    return OccupancyMap(None, 0.5, origin, "test", cells.astype(np.uint8))


def unit_edges(cells: np.ndarray) -> set[tuple[float, float, float, float]]:
    """Each side of a cell between occupied and not, by hand."""
    height, width = cells.shape

    def wall(row: int, column: int) -> bool:
        inside = 0 <= row < height and 0 <= column < width
        return inside and 65 <= cells[row, column] <= 100

    found = set()
    for row in range(height + 1):
        for column in range(width + 1):
            if wall(row, column) != wall(row - 1, column):
                found.add((column, row, column + 1, row))
            if wall(row, column) != wall(row, column - 1):
                found.add((column, row, column, row + 1))
    return found


@pytest.mark.parametrize("seed", range(0, 20, stride(4)))
def test_the_segments_are_the_sides_of_occupied_cells(seed: int) -> None:
    chance = np.random.default_rng(seed)
    cells = chance.choice([0, 30, 64, 65, 100, UNKNOWN], size=chance.integers(1, 12, 2))
    pieces = []
    for x0, y0, x1, y1 in wall_segments(given(cells)):
        a, b, c, d = (round(each / 0.5) for each in (x0, y0, x1, y1))
        assert (a == c) != (b == d)
        length = abs(c - a) + abs(d - b)
        dx, dy = (c - a) // length, (d - b) // length
        pieces += [(a + i * dx, b + i * dy, a + (i + 1) * dx, b + (i + 1) * dy)
                   for i in range(length)]  # fmt: skip
    assert len(pieces) == len(set(pieces))
    assert set(pieces) == unit_edges(cells)


def test_a_long_wall_is_four_segments_and_the_origin_places_it() -> None:
    cells = np.zeros((3, 100))
    cells[1] = 100
    found = wall_segments(given(cells, (10.0, 20.0, math.pi / 2)))
    assert len(found) == 4
    xs = [x for a, _, c, _ in found for x in (a, c)]
    ys = [y for _, b, _, d in found for y in (b, d)]
    assert (min(xs), max(xs)) == (9.0, 9.5)
    assert (min(ys), max(ys)) == (20.0, 70.0)


def test_noise_is_pooled_and_no_wall_is_lost() -> None:
    cells = np.random.default_rng(1).choice([0, 100], p=[0.8, 0.2], size=(600, 600))
    found = wall_segments(given(cells))
    assert 0 < len(found) <= MOST_SEGMENTS
    assert wall_segments(given(np.full((5, 5), UNKNOWN))) == []


def test_a_map_of_noise_takes_little_memory() -> None:
    """Its outline has millions of segments, of which none is made."""
    cells = np.random.default_rng(2).integers(0, 2, (2000, 2000), np.uint8) * np.uint8(100)
    noise = given(cells)
    tracemalloc.start()
    found = wall_segments(noise)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 0 < len(found) <= MOST_SEGMENTS
    assert peak < 20 * cells.nbytes
