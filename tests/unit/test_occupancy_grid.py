"""Occupancy grids of the fold: what is a wall, the region of a pose, what two poses may share."""

import time

import numpy as np
import pytest

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.map_regions import NOWHERE
from projections.fold.occupancy import MAX_BLOCKS, OccupancyGrid

M = 1_000_000


def _map(cells: np.ndarray, resolution: float = 0.1, **more: object) -> OccupancyMap:
    origin = more.get("origin", (0.0, 0.0, 0.0))
    return OccupancyMap(None, resolution, origin, "test", cells.astype(np.uint8))  # type: ignore[arg-type]


def _two_rooms(resolution: float = 0.1, door_m: float = 0.9) -> np.ndarray:
    """Two rooms, 3 m by 3 m each, with a wall at x = 3 and a door in its middle, y = 1.5."""
    n = round(3 / resolution)
    cells = np.zeros((n, 2 * n + 1))
    cells[[0, -1], :] = cells[:, [0, -1, n]] = 100
    half = round(door_m / resolution / 2)
    cells[n // 2 - half : n // 2 + half, n] = 0
    return cells


@pytest.mark.parametrize("resolution", [0.02, 0.05, 0.1])
def test_poses_beside_a_door_are_of_their_own_room(resolution: float) -> None:
    grid = OccupancyGrid(_map(_two_rooms(resolution), resolution))
    left, right = (2 * M, int(1.5 * M)), (int(4.1 * M), int(1.5 * M))
    assert grid.is_free_line(left, right)
    assert grid.region(left) != grid.region(right)
    assert not grid.passable(left, right), "the line passes a door"
    assert grid.passable(left, (M, M))
    assert grid.passable(right, (5 * M, 2 * M))
    assert not grid.is_free_line((M, M // 2), (5 * M, M // 2)), "the line meets the wall"


def test_a_way_in_a_small_region_counts_as_a_quarter_and_through_a_door_as_none() -> None:
    hall = np.zeros((160, 160))
    hall[[0, -1], :] = hall[:, [0, -1]] = 100
    large, small = OccupancyGrid(_map(hall)), OccupancyGrid(_map(_two_rooms()))
    assert large.straight_way_um((M, M), (2 * M, M)) == M
    assert small.straight_way_um((M, M), (2 * M, M)) == M // 4
    assert small.straight_way_um((2 * M, int(1.5 * M)), (int(4.1 * M), int(1.5 * M))) is None


def test_a_way_in_a_long_corridor_counts_as_a_quarter_and_in_a_hall_as_large_whole() -> None:
    for wide, share in ((3, 4), (8, 1)):
        cells = np.zeros((wide * 10 + 2, 600))
        cells[[0, -1], :] = cells[:, [0, -1]] = 100
        grid = OccupancyGrid(_map(cells))
        assert grid.straight_way_um((20 * M, M), (24 * M, M)) == 4 * M // share


def test_a_wall_parts_what_one_region_holds() -> None:
    cells = np.zeros((60, 60))
    cells[10:50, 30] = 100
    grid = OccupancyGrid(_map(cells))
    a, b = (int(2.5 * M), 3 * M), (int(3.6 * M), 3 * M)
    assert not grid.passable(a, b)


def test_unknown_cells_and_those_below_65_percent_are_no_walls() -> None:
    for value, is_wall in ((255, False), (0, False), (64, False), (65, True), (100, True)):
        cells = np.zeros((20, 20))
        cells[:, 10] = value
        grid = OccupancyGrid(_map(cells))
        assert grid.is_wall((int(1.05 * M), M)) == is_wall
        assert grid.passable((M // 2, M), (int(1.6 * M), M)) != is_wall


def test_small_things_are_no_walls() -> None:
    cells = np.zeros((30, 30))
    cells[10:14, 10:14] = 100  # a table's leg, or a chair
    cells[20, 10:16] = 100  # a short wall
    grid = OccupancyGrid(_map(cells))
    assert np.argwhere(grid.walls).tolist() == [[20, column] for column in range(10, 16)]


def test_a_pose_in_a_wall_is_of_the_side_that_is_nearer() -> None:
    cells = _two_rooms()
    cells[:, 28:33] = 100  # half a metre thick, without a door
    grid = OccupancyGrid(_map(cells))
    left, right = (2 * M, M), (int(4.2 * M), M)
    inside = (int(2.85 * M), M)
    assert grid.is_wall(inside)
    assert grid.passable(inside, left)
    assert not grid.passable(inside, right)
    assert not grid.passable(left, right)


def test_poses_deep_in_walls_are_in_no_region() -> None:
    cells = np.full((40, 40), 100.0)
    cells[:3, :3] = 0
    grid = OccupancyGrid(_map(cells))
    assert grid.region((3 * M, 3 * M)) == NOWHERE
    assert grid.region((M // 10, M // 10)) == 0


def test_outside_the_grid_only_walls_on_the_way_count() -> None:
    cells = np.zeros((40, 40))
    cells[:, 20] = 100
    grid = OccupancyGrid(_map(cells, origin=(10.0, -5.0, 0.0)))
    left, right, beyond = (9 * M, -3 * M), (15 * M, -3 * M), (9 * M, 3 * M)
    inside = (11 * M, -3 * M)
    assert grid.region(left) is None
    assert grid.region(inside) is not None
    assert not grid.is_wall(left)
    assert grid.straight_way_um(left, inside) == 2 * M  # whole, though the room is small
    assert grid.straight_way_um(left, beyond) == 6 * M
    assert grid.straight_way_um(inside, (12 * M - M // 10, -3 * M)) == (M - M // 10) // 4
    assert not grid.passable(left, right)


def test_a_pose_outside_does_not_take_the_wall_away_that_it_meets_first() -> None:
    cells = np.zeros((40, 40))
    cells[:, [0, 39]] = 100
    grid = OccupancyGrid(_map(cells))
    outside, in_far_wall = (-M, 2 * M), (int(3.95 * M), 2 * M)
    assert grid.is_wall(in_far_wall)
    assert not grid.is_free_line(outside, in_far_wall)


def test_origin_and_yaw_say_where_the_grid_lies() -> None:
    cells = _two_rooms()
    plain = OccupancyGrid(_map(cells))
    turned = OccupancyGrid(_map(cells, origin=(7.0, -2.0, np.pi / 2)))
    for x, y in ((2.0, 1.5), (4.1, 1.5), (3.05, 0.5), (0.5, 2.5)):
        at, moved = (int(x * M), int(y * M)), (int((7 - y) * M), int((x - 2) * M))
        assert plain.region(at) == turned.region(moved)
        assert plain.is_wall(at) == turned.is_wall(moved)


@pytest.mark.seconds
@pytest.mark.slow
def test_the_largest_map_takes_bounded_time() -> None:
    rng = np.random.default_rng(1)
    cells = np.where(rng.random((4000, 4000)) < 0.1, 100, 0)
    started = time.process_time()
    grid = OccupancyGrid(_map(cells, 0.05))
    assert time.process_time() - started < 20
    assert grid.regions.size <= MAX_BLOCKS
    started = time.process_time()
    for _ in range(100):
        grid.is_free_line((0, 0), (200 * M, 200 * M))
    assert (time.process_time() - started) / 100 < 0.2
