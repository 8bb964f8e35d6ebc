"""Routes over random floors, against a search that asks for every route."""

import itertools
import math
from collections.abc import Sequence

from hypothesis import example, given
from hypothesis import strategies as st

from eventsrc.adapters.sim.drive import DriveGrid, nearest_by_route
from eventsrc.adapters.sim.floorplan import Point, Rect, Segment, Walls
from eventsrc.base.errors import MapfoldError

OUTLINE = Rect(0.0, 0.0, 6.0, 4.0)
SPOTS: list[Point] = [(1.0, 1.0), (5.0, 1.0), (5.0, 3.0), (1.0, 3.0)]
AROUND_THE_BARS: list[Point] = [(i / 2, j / 2) for i in (3, 5, 7, 9) for j in range(1, 8)]
BORDER = [
    Segment(0.0, 0.0, 6.0, 0.0),
    Segment(6.0, 0.0, 6.0, 4.0),
    Segment(6.0, 4.0, 0.0, 4.0),
    Segment(0.0, 4.0, 0.0, 0.0),
]
BARS = st.builds(
    lambda x, y, length: Segment(x, y, x, y + length),
    st.sampled_from([2.0, 3.0, 4.0]),
    st.sampled_from([0.0, 0.5, 1.0]),
    st.sampled_from([1.5, 2.0, 3.0, 4.0]),
)


def _floor(bars: list[Segment]) -> DriveGrid:
    return DriveGrid(OUTLINE, Walls([*BORDER, *bars]), [])


FLOORS = st.lists(BARS, max_size=4).map(_floor)
BEHIND_A_BAR = [(2.5, 0.5), (3.5, 0.5), (0.5, 3.5)]
"""A start, a goal near it with a long way around a bar, and a goal in the open, farther away."""


def _length(grid: DriveGrid, start: Point, goal: Point) -> float:
    try:
        route = grid.route(start, goal)
    except MapfoldError:
        return math.inf
    return math.fsum(math.dist(a, b) for a, b in itertools.pairwise(route))


def _reached(grid: DriveGrid, spots: Sequence[Point]) -> bool:
    return all(_length(grid, spots[0], spot) < math.inf for spot in spots[1:])


@given(FLOORS)
def test_floors_connect_where_there_are_routes(grid: DriveGrid) -> None:
    assert grid.connects(SPOTS) == _reached(grid, SPOTS)


@example(_floor([Segment(3.0, 0.0, 3.0, 3.2)]), BEHIND_A_BAR)
@given(FLOORS, st.lists(st.sampled_from(AROUND_THE_BARS), min_size=3, unique=True))
def test_the_nearest_goal_has_the_shortest_route(grid: DriveGrid, spots: list[Point]) -> None:
    start, *goals = spots
    if all(grid.free(*spot) for spot in spots) and _reached(grid, spots):
        nearest = nearest_by_route(grid, start, goals)
        lengths = {goal: _length(grid, start, goal) for goal in goals}
        assert lengths[nearest] <= min(lengths.values()) + 1e-9
