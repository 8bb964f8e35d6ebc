"""The simulated house: enough rooms and objects, walls where rooms end, doors that let through."""

from collections import Counter
from itertools import combinations

import pytest

from eventsrc.adapters.sim.floorplan import DOOR_M, OPENING_M, build_floor_plan
from eventsrc.adapters.sim.house import House, build_house

SEEDS = (0, 7, 11, 2**40)


@pytest.fixture(params=SEEDS, scope="module")
def house(request: pytest.FixtureRequest) -> House:
    return build_house(request.param)


def test_has_enough_rooms_objects_and_classes(house: House) -> None:
    assert len(house.plan.rooms) >= 6
    assert len(house.things) >= 40
    assert len({thing.model.class_name for thing in house.things}) >= 20


def test_some_objects_are_of_one_model_and_some_classes_have_several_models(house: House) -> None:
    by_model = Counter(thing.model.name for thing in house.things)
    assert by_model["chair-dining"] == 6
    chairs = {t.model.name for t in house.things if t.model.class_name == "chair"}
    assert len(chairs) == 2


def test_instances_have_names_of_their_own(house: House) -> None:
    assert len({thing.instance for thing in house.things}) == len(house.things)


def test_things_stand_in_their_room_and_not_in_each_other(house: House) -> None:
    for thing in house.things:
        assert house.plan.room(thing.room).rect.encloses(thing.footprint)
    standing = [thing for thing in house.things if thing.model.stands]
    for one, other in combinations(standing, 2):
        assert not one.footprint.overlaps(other.footprint), (one.instance, other.instance)


def test_rooms_tile_the_outline_without_overlap(house: House) -> None:
    rects = [room.rect for room in house.plan.rooms]
    outline = house.plan.outline
    assert sum(r.width * r.height for r in rects) == pytest.approx(outline.width * outline.height)
    assert not any(a.overlaps(b) for a, b in combinations(rects, 2))


def test_doors_let_sight_through_and_walls_beside_them_do_not(house: House) -> None:
    for door in house.plan.doors:
        x, y = door.centre
        beside = door.width_m / 2 + 0.1
        across = (0.0, 0.2) if door.flat else (0.2, 0.0)
        along = (beside, 0.0) if door.flat else (0.0, beside)
        for sign in (-1, 1):
            jamb = (x + sign * along[0], y + sign * along[1])
            assert house.walls.block(*_pair(jamb, across)), (door, sign)
        assert not house.walls.block(*_pair((x, y), across)), door


def test_every_room_can_be_reached_through_doors(house: House) -> None:
    joined = {"hall"}
    for _ in house.plan.rooms:
        for door in house.plan.doors:
            if joined & set(door.rooms):
                joined |= set(door.rooms)
    assert joined == {room.name for room in house.plan.rooms}
    assert {door.width_m for door in house.plan.doors} == {DOOR_M, OPENING_M}


def test_equal_seeds_give_equal_houses_and_others_do_not() -> None:
    assert build_house(3).things == build_house(3).things
    assert build_floor_plan(3) == build_floor_plan(3)
    assert build_floor_plan(3) != build_floor_plan(4)


def _pair(
    middle: tuple[float, float], offset: tuple[float, float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    (x, y), (dx, dy) = middle, offset
    return (x - dx, y - dy), (x + dx, y + dy)
