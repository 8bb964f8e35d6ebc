"""Lines through an occupancy grid, against an oracle in fractions; symmetric, whatever the ends."""

import itertools
from fractions import Fraction

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.occupancy import OccupancyGrid, Point
from tests.support.thorough import examples

ROWS, COLUMNS, SIDE_UM = 7, 9, 100_000


def _grid(seed: int, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> OccupancyGrid:
    """A grid with walls at random; what would be too small to be a wall is one here."""
    drawn = np.random.default_rng(seed).random((ROWS, COLUMNS)) < 0.2
    cells = np.where(drawn, 100, 0).astype(np.uint8)
    grid = OccupancyGrid(OccupancyMap(None, SIDE_UM / 1e6, origin, "test", cells))
    grid.walls = drawn
    grid._rows = [row.tobytes() for row in drawn.astype(np.uint8)]
    return grid


GRIDS = [_grid(seed) for seed in range(12)]
whole = st.integers(-3, 12).map(lambda n: n * SIDE_UM)
anywhere = st.integers(-2 * SIDE_UM, 11 * SIDE_UM)
coordinate = whole | anywhere | st.builds(int.__add__, whole, st.integers(-2, 2))
points = st.tuples(coordinate, coordinate)


def _cells(a: Point, b: Point) -> list[tuple[int, int]]:
    """(row, column) of the points of a line, in order from a to b: those of all crossings of grid
    lines, and one between any two crossings."""
    crossings = {Fraction(0), Fraction(1)}
    for start, end in zip(a, b, strict=True):
        for edge in range(-5 * SIDE_UM, 15 * SIDE_UM, SIDE_UM):
            if start != end and 0 <= (t := Fraction(edge - start, end - start)) <= 1:
                crossings.add(t)
    at = sorted(crossings)
    at = sorted([*at, *((s + t) / 2 for s, t in itertools.pairwise(at))])
    found = []
    for t in at:
        x, y = (s + t * (e - s) for s, e in zip(a, b, strict=True))
        cell = int(y // SIDE_UM), int(x // SIDE_UM)
        if not found or found[-1] != cell:
            found.append(cell)
    return found


def _is_free(grid: OccupancyGrid, a: Point, b: Point) -> bool:
    met = []
    for row, column in _cells(a, b):
        inside = 0 <= row < ROWS and 0 <= column < COLUMNS
        met.append(inside and bool(grid.walls[row, column]))
    while met and met[0]:
        met.pop(0)
    while met and met[-1]:
        met.pop()
    return not any(met)


@settings(max_examples=examples(1500))
@given(st.sampled_from(GRIDS), points, points)
@example(GRIDS[0], (0, 0), (0, 0))
@example(GRIDS[0], (0, 0), (9 * SIDE_UM, 7 * SIDE_UM))
@example(GRIDS[1], (-SIDE_UM, 3 * SIDE_UM), (12 * SIDE_UM, 3 * SIDE_UM))
@example(GRIDS[2], (4 * SIDE_UM, -SIDE_UM), (4 * SIDE_UM, 9 * SIDE_UM))
def test_a_line_is_free_exactly_where_its_points_meet_no_wall(
    grid: OccupancyGrid, a: Point, b: Point
) -> None:
    assert grid.is_free_line(a, b) == _is_free(grid, a, b)
    assert grid.is_free_line(b, a) == grid.is_free_line(a, b)
    assert grid.passable(a, b) == grid.passable(b, a)


@settings(max_examples=examples(1500))
@given(st.sampled_from(GRIDS), points, points)
def test_the_cells_of_a_line_are_those_of_its_points(
    grid: OccupancyGrid, a: Point, b: Point
) -> None:
    start, end = sorted((a, b), key=lambda p: (p[1], p[0]))
    walked = {
        (row, column)
        for row, first, last in grid._line(start, end)
        for column in range(first, last + 1)
    }
    inside = {(r, c) for r, c in _cells(a, b) if 0 <= r < ROWS and 0 <= c < COLUMNS}
    assert walked == inside


@settings(max_examples=examples(1500))
@given(points, points, st.floats(-3.2, 3.2), st.tuples(*[st.floats(-50, 50)] * 2))
def test_a_turned_grid_is_the_grid_seen_from_a_turned_frame(
    a: Point, b: Point, yaw: float, corner: tuple[float, float]
) -> None:
    """Points are turned by the same integers; what is then walked is the grid as it stands."""
    turned = _grid(3, (*corner, yaw))
    moved = [turned._to_grid(point) for point in (a, b)]
    assert turned.is_free_line(a, b) == GRIDS[3].is_free_line(*moved)
    dx, dy = (a[i] / 1e6 - corner[i] for i in (0, 1))
    u, v = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
    assert np.allclose(np.array(moved[0]) / 1e6, (u, v), atol=4e-6)


far = st.integers(-(10**13), 10**13)


@settings(max_examples=examples(1500))
@given(st.tuples(far, far), st.tuples(far, far))
def test_lines_of_any_length_are_walked_within_the_grid_only(a: Point, b: Point) -> None:
    start, end = sorted((a, b), key=lambda p: (p[1], p[0]))
    assert len(GRIDS[0]._line(start, end)) <= ROWS
    assert GRIDS[0].passable(a, b) == GRIDS[0].passable(b, a)
