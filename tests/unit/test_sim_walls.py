"""The occupancy map of a simulated house: walls where they are, free where the robot drove."""

import numpy as np
import pytest

from eventsrc.adapters.sim import build_house, occupancy_map
from eventsrc.envelope.occupancy_map import OCCUPIED, decode_map
from projections.fold.occupancy import OccupancyGrid
from tests.support.logs import simulated


@pytest.mark.parametrize("seed", [1, 7, 12])
def test_walls_are_occupied_and_doors_are_not(seed: int) -> None:
    house = build_house(seed)
    given = occupancy_map(house)
    assert decode_map(given.encode()).digest() == given.digest()
    grid = OccupancyGrid(given)
    for wall in house.plan.walls:
        for share in (0.0, 0.25, 0.5, 1.0):
            x = wall.x0 + share * (wall.x1 - wall.x0)
            y = wall.y0 + share * (wall.y1 - wall.y0)
            assert grid.is_wall((round(x * 1e6), round(y * 1e6)))
    assert 0.01 < float(np.mean(given.cells == OCCUPIED)) < 0.1


@pytest.mark.seconds
def test_the_robot_drove_through_no_wall() -> None:
    run = simulated(7, "a")
    grid = OccupancyGrid(occupancy_map(run.house))
    for pose in run.true_poses:
        assert not grid.is_wall((round(pose.x * 1e6), round(pose.y * 1e6)))


def test_the_same_house_has_the_same_map() -> None:
    first, again = (occupancy_map(build_house(3)) for _ in range(2))
    assert first.encode() == again.encode()
    assert first.digest() != occupancy_map(build_house(4)).digest()
