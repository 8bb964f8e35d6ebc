"""The robot's drive: through doors only, never into anything, a keyframe when one is due."""

import itertools
import math

import pytest

from eventsrc.adapters.sim.drive import (
    KEYFRAME_M,
    KEYFRAME_RAD,
    TruePose,
    drive,
    keyframes,
)
from eventsrc.adapters.sim.floorplan import Segment, wrap
from eventsrc.adapters.sim.house import House, build_house
from eventsrc.adapters.sim.simulation import plan_tour
from tests.support.thorough import mostly_slow

pytestmark = pytest.mark.seconds

SEEDS_AND_RUNS = [(7, "a"), (7, "b"), (3, "a"), (12, "c")]
Drive = tuple[House, str, list[TruePose]]
ROBOT_RADIUS_M = 0.18


@pytest.fixture(params=mostly_slow((each,) for each in SEEDS_AND_RUNS), ids=str, scope="module")
def driven(request: pytest.FixtureRequest) -> Drive:
    seed, run = request.param
    house = build_house(seed)
    return house, run, list(drive(house.grid, plan_tour(house, run)))


def test_keeps_its_radius_from_walls_and_furniture(driven: Drive) -> None:
    house, _, poses = driven
    standing = [thing.footprint for thing in house.things if thing.model.stands]
    for pose in poses[::4]:  # every 0.2 s, at most 10 cm apart
        nearest = min(_distance(wall, pose.x, pose.y) for wall in house.plan.walls)
        assert nearest >= ROBOT_RADIUS_M, pose
        assert not any(
            rect.grown(ROBOT_RADIUS_M - 0.05).contains(pose.x, pose.y) for rect in standing
        )


def test_crosses_no_wall_between_two_ticks(driven: Drive) -> None:
    house, _, poses = driven
    moved = [(a, b) for a, b in itertools.pairwise(poses) if (a.x, a.y) != (b.x, b.y)]
    assert not any(house.walls.block((a.x, a.y), (b.x, b.y)) for a, b in moved)


def test_visits_every_room(driven: Drive) -> None:
    house, _, poses = driven
    visited = {house.plan.room_at(pose.x, pose.y) for pose in poses}
    assert visited == {room.name for room in house.plan.rooms}


def test_moves_like_a_robot(driven: Drive) -> None:
    _, _, poses = driven
    for a, b in itertools.pairwise(poses):
        assert b.time_s > a.time_s
        assert math.hypot(b.x - a.x, b.y - a.y) <= 0.5 * 0.05 + 1e-6
        assert abs(wrap(b.yaw_rad - a.yaw_rad)) <= math.radians(2.0) + 1e-9


def test_a_keyframe_comes_when_due_and_not_before(driven: Drive) -> None:
    _, _, poses = driven
    chosen = list(keyframes(iter(poses)))
    assert chosen[0] == poses[0]
    index = {pose: number for number, pose in enumerate(poses)}
    for a, b in itertools.pairwise(chosen):
        assert _far(a, b)
        assert not any(_far(a, pose) for pose in poses[index[a] + 1 : index[b]])


def test_a_look_around_sees_every_direction() -> None:
    house = build_house(7)
    first = plan_tour(house, "b")[0]
    assert first.look_around
    turned = list(keyframes(drive(house.grid, [first])))
    yaws = sorted(pose.yaw_rad % (2 * math.pi) for pose in turned)
    gaps = [b - a for a, b in itertools.pairwise([*yaws, yaws[0] + 2 * math.pi])]
    assert max(gaps) < math.radians(20)


def _far(a: TruePose, b: TruePose) -> bool:
    return (
        math.hypot(b.x - a.x, b.y - a.y) >= KEYFRAME_M - 1e-6
        or abs(wrap(b.yaw_rad - a.yaw_rad)) >= KEYFRAME_RAD - 1e-6
    )


def _distance(wall: Segment, x: float, y: float) -> float:
    """To an upright piece of wall; all of ours are."""
    dx = max(min(wall.x0, wall.x1) - x, 0.0, x - max(wall.x0, wall.x1))
    dy = max(min(wall.y0, wall.y1) - y, 0.0, y - max(wall.y0, wall.y1))
    return math.hypot(dx, dy)
