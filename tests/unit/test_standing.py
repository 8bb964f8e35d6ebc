"""The place of an Object where walls are known: the one on whose floor it stands."""

import pytest

from projections.fold.deltas import ObjectEstimated, ObjectOrdinal, PlaceOrdinal
from projections.fold.free_floor import FreeFloor
from projections.fold.occupancy import OccupancyGrid, Point
from projections.fold.pair_groups import PlaceSurvivors
from projections.fold.standing import Standing
from tests.support.maps import drawn_map

WALL = "#" * 40
ROOM = "#" + "." * 18 + "#" + "." * 19 + "#"
DOOR = "#" + "." * 38 + "#"
TWO_ROOMS = "\n".join([WALL, *[ROOM] * 8, *[DOOR] * 4, *[ROOM] * 8, WALL])
"""Two rooms of 3.8 by 4 m, of cells of 0.2 m, and a door of 0.8 m in the wall at x = 3.9."""
LEFT, RIGHT, CUP = PlaceOrdinal(0), PlaceOrdinal(1), ObjectOrdinal(0)
IN_LEFT, IN_RIGHT = (2_000_000, 2_000_000), (6_000_000, 2_000_000)


@pytest.fixture
def survivors() -> PlaceSurvivors:
    return PlaceSurvivors()


@pytest.fixture
def standing(survivors: PlaceSurvivors) -> Standing:
    """A robot was in both rooms."""
    ground = FreeFloor(OccupancyGrid(drawn_map(TWO_ROOMS, 0.2)))
    reducer = Standing(lambda at: (0, ground, at), survivors)
    reducer.pose_placed(*IN_LEFT, LEFT)
    reducer.pose_placed(*IN_RIGHT, RIGHT)
    return reducer


def see(standing: Standing, x_m: float, y_m: float, seen_from: Point, error_m: float = 0.1) -> None:
    variance = round(error_m * 1e6) ** 2
    at = round(x_m * 1e6), round(y_m * 1e6)
    standing.object_estimated(ObjectEstimated(0, CUP, *at, variance, 0, variance, 1), seen_from)
    standing.decide()


def test_an_object_is_in_the_room_that_it_stands_in_wherever_it_was_seen_from(
    standing: Standing,
) -> None:
    see(standing, 6.5, 2.0, IN_LEFT)
    assert standing.place_of(CUP) == RIGHT


def test_a_picture_on_a_wall_is_on_the_side_that_it_was_seen_from(standing: Standing) -> None:
    see(standing, 3.95, 3.5, IN_LEFT)
    assert standing.place_of(CUP) == LEFT


def test_an_estimate_just_behind_a_wall_is_in_front_of_it(standing: Standing) -> None:
    see(standing, 4.15, 3.5, (2_000_000, 3_500_000))
    assert standing.place_of(CUP) == LEFT


def test_an_object_behind_a_wall_is_on_the_side_of_the_nearest_pose_that_saw_it(
    standing: Standing,
) -> None:
    see(standing, 4.1, 3.5, (1_000_000, 3_500_000))
    assert standing.place_of(CUP) == LEFT
    see(standing, 4.1, 3.5, (5_000_000, 3_500_000))
    assert standing.place_of(CUP) == RIGHT
    see(standing, 4.1, 3.5, (1_000_000, 3_500_000), error_m=0.05)
    assert standing.place_of(CUP) == RIGHT


def test_an_object_changes_place_only_when_it_likely_stands_elsewhere(standing: Standing) -> None:
    """Below the door, where the wall ends: of the four points two, then one are on the left."""
    see(standing, 3.0, 2.2, IN_LEFT)
    see(standing, 4.6, 2.0, IN_LEFT, error_m=2.0)
    assert standing.place_of(CUP) == LEFT, "two of the four points are on the left of the wall"
    see(standing, 4.6, 2.0, IN_LEFT, error_m=0.8)
    assert standing.place_of(CUP) == RIGHT, "one of the four points is on the left of the wall"


def test_an_object_outside_the_map_stays_where_it_was(standing: Standing) -> None:
    see(standing, 3.0, 2.0, IN_LEFT)
    see(standing, 30.0, 20.0, (29_000_000, 20_000_000))
    assert standing.place_of(CUP) == LEFT


def test_an_object_in_a_room_that_no_robot_was_in_is_where_one_looked_in_until_one_comes(
    survivors: PlaceSurvivors,
) -> None:
    ground = FreeFloor(OccupancyGrid(drawn_map(TWO_ROOMS, 0.2)))
    standing = Standing(lambda at: (0, ground, at), survivors)
    see(standing, 6.5, 2.0, IN_LEFT)
    assert standing.place_of(CUP) is None
    standing.pose_placed(*IN_LEFT, LEFT)
    see(standing, 6.5, 2.0, IN_LEFT, error_m=0.05)
    assert standing.place_of(CUP) == LEFT
    standing.pose_placed(*IN_RIGHT, RIGHT)
    assert standing.decide() == [CUP]
    assert standing.place_of(CUP) == RIGHT


@pytest.mark.parametrize("is_resumed", [False, True])
def test_a_robot_of_another_place_that_comes_nearer_than_all_before_takes_an_object(
    survivors: PlaceSurvivors, *, is_resumed: bool
) -> None:
    """A hall of two places; only a pose that is nearer than the nearest one decides again."""
    hall = "\n".join(["#" * 42, *["#" + "." * 40 + "#"] * 10, "#" * 42])
    ground = FreeFloor(OccupancyGrid(drawn_map(hall, 0.2)))
    reducer = Standing(lambda at: (0, ground, at), survivors)
    reducer.pose_placed(1_100_000, 1_100_000, LEFT)
    reducer.pose_placed(7_900_000, 1_100_000, RIGHT)
    see(reducer, 3.1, 1.1, (1_100_000, 1_100_000))
    assert reducer.place_of(CUP) == LEFT
    if is_resumed:
        state, reducer = reducer.dump(), Standing(lambda at: (0, ground, at), survivors)
        reducer.load(state)
    reducer.pose_placed(6_100_000, 1_100_000, RIGHT)
    assert not reducer.decide()
    reducer.pose_placed(3_900_000, 1_100_000, RIGHT)
    assert reducer.decide() == [CUP]
    assert reducer.place_of(CUP) == RIGHT


def test_a_hall_of_two_places_is_parted_where_their_poses_are_equally_near(
    survivors: PlaceSurvivors,
) -> None:
    hall = "\n".join(["#" * 42, *["#" + "." * 40 + "#"] * 10, "#" * 42])
    ground = FreeFloor(OccupancyGrid(drawn_map(hall, 0.2)))
    standing = Standing(lambda at: (0, ground, at), survivors)
    standing.pose_placed(1_100_000, 1_100_000, LEFT)
    standing.pose_placed(7_100_000, 1_100_000, RIGHT)
    see(standing, 3.9, 1.1, (1_100_000, 1_100_000))
    assert standing.place_of(CUP) == LEFT
    see(standing, 4.6, 1.1, (1_100_000, 1_100_000))
    assert standing.place_of(CUP) == RIGHT


def test_objects_of_an_absorbed_place_are_in_its_survivor(
    standing: Standing, survivors: PlaceSurvivors
) -> None:
    see(standing, 6.5, 2.0, IN_RIGHT)
    survivors.merge(LEFT, (RIGHT,))
    assert list(standing.place_absorbed(LEFT, RIGHT)) == [CUP]
    assert standing.place_of(CUP) == LEFT


@pytest.mark.parametrize("is_resumed", [False, True])
def test_a_fold_that_is_resumed_decides_the_same_objects_as_one_that_goes_on(
    survivors: PlaceSurvivors, *, is_resumed: bool
) -> None:
    """A place absorbs one of a region in which it had no pose of its own, and then gets one."""
    ground = FreeFloor(OccupancyGrid(drawn_map(TWO_ROOMS, 0.2)))
    reducer = Standing(lambda at: (0, ground, at), survivors)
    other = PlaceOrdinal(2)
    reducer.pose_placed(*IN_RIGHT, LEFT)
    reducer.pose_placed(1_000_000, 3_000_000, RIGHT)
    reducer.pose_placed(3_400_000, 3_000_000, other)
    see(reducer, 2.0, 3.0, (1_000_000, 3_000_000))
    reducer.pose_placed(2_000_000, 3_000_000, other)
    reducer.decide()
    survivors.merge(LEFT, [RIGHT])
    reducer.place_absorbed(LEFT, RIGHT)
    if is_resumed:
        state, reducer = reducer.dump(), Standing(lambda at: (0, ground, at), survivors)
        reducer.load(state)
    reducer.pose_placed(1_000_000, 2_600_000, LEFT)
    assert CUP not in reducer.decide()
