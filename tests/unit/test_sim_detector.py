"""The camera: pinhole boxes, field of view, range, and walls that hide."""

import math
from dataclasses import replace

import pytest

from eventsrc.adapters.sim.detector import (
    FOCAL_PX,
    HEIGHT_PX,
    WIDTH_PX,
    VisibleObject,
    visible_objects,
)
from eventsrc.adapters.sim.drive import TruePose
from eventsrc.adapters.sim.floorplan import FloorPlan, Rect, Segment
from eventsrc.adapters.sim.house import MODELS, House, SimulatedThing, build_house

FAR_WALL = Segment(-50.0, -50.0, -50.0, 50.0)


def _house(*things: SimulatedThing, walls: tuple[Segment, ...] = (FAR_WALL,)) -> House:
    return House(0, FloorPlan(Rect(-50, -50, 50, 50), (), (), walls), things)


def _lamp(x: float, y: float) -> SimulatedThing:
    model = MODELS["lamp-floor"]
    return SimulatedThing("lamp-floor-1", model, "", Rect.around(x, y, 0.35, 0.35), math.pi)


def _seen(house: House, yaw: float = 0.0) -> list[VisibleObject]:
    return list(visible_objects(house, TruePose(0.0, 0.0, 0.0, yaw)))


def test_a_thing_straight_ahead_is_centred_and_as_large_as_a_pinhole_makes_it() -> None:
    (seen,) = _seen(_house(_lamp(3.0, 0.0)))
    x0, y0, x1, y1 = seen.box
    near = 3.0 - 0.35 / 2
    assert (x0 + x1) / 2 == pytest.approx(WIDTH_PX / 2)
    assert x1 - x0 == pytest.approx(FOCAL_PX * 0.35 / near)
    assert y1 == pytest.approx(HEIGHT_PX / 2 + FOCAL_PX * 0.75 / near)
    assert y0 == pytest.approx(HEIGHT_PX / 2 - FOCAL_PX * (1.5 - 0.75) / near)
    assert seen.distance_m == 3.0
    assert seen.side_rad == pytest.approx(0.0)  # it faces us


def test_left_of_the_robot_is_left_in_the_picture() -> None:
    (seen,) = _seen(_house(_lamp(3.0, 1.0)))
    middle = (seen.box[0] + seen.box[2]) / 2
    bearing = math.atan2(WIDTH_PX / 2 - middle, FOCAL_PX)
    assert bearing == pytest.approx(math.atan2(1.0, 3.0), abs=0.02)


@pytest.mark.parametrize("degrees", [36.0, -36.0, 90.0, 180.0])
def test_outside_the_field_of_view_nothing_is_seen(degrees: float) -> None:
    assert _seen(_house(_lamp(3.0, 0.0)), yaw=math.radians(degrees)) == []


def test_just_inside_the_field_of_view_it_is() -> None:
    assert len(_seen(_house(_lamp(3.0, 0.0)), yaw=math.radians(33.0))) == 1


@pytest.mark.parametrize("distance", [0.3, 5.1])
def test_too_near_or_too_far_is_not_seen(distance: float) -> None:
    assert _seen(_house(_lamp(distance, 0.0))) == []


def test_a_wall_hides_and_a_gap_in_it_does_not() -> None:
    lamp = _lamp(3.0, 0.0)
    assert _seen(_house(lamp, walls=(Segment(1.5, -2, 1.5, 2),))) == []
    gap = (Segment(1.5, -2, 1.5, -0.4), Segment(1.5, 0.4, 1.5, 2))
    assert len(_seen(_house(lamp, walls=gap))) == 1


def test_boxes_stay_in_the_picture_and_nothing_shows_through_a_real_house_wall() -> None:
    house = build_house(7)
    room = house.plan.room("bathroom")
    x, y = house.grid.clearest(room.rect.centre, room.rect, 1.2)
    seen_here: set[str] = set()
    for step in range(24):
        for seen in visible_objects(house, TruePose(0.0, x, y, step * math.tau / 24)):
            x0, y0, x1, y1 = seen.box
            assert 0 <= x0 < x1 <= WIDTH_PX
            assert 0 <= y0 < y1 <= HEIGHT_PX
            seen_here.add(seen.thing.room)
    assert seen_here <= {"bathroom", "hall"} | {
        room for door in house.plan.doors for room in door.rooms if "hall" in door.rooms
    }
    assert "bathroom" in seen_here


def test_the_side_that_shows_is_told_from_the_front_of_the_thing() -> None:
    lamp = replace(_lamp(3.0, 0.0), facing_rad=math.pi / 2)
    (seen,) = _seen(_house(lamp))
    assert seen.side_rad == pytest.approx(math.pi / 2)
