"""The bench's walls: maps of buildings, and places folded with them."""

import numpy as np

from projections.fold.settings import CameraConstants, Settings
from projections.localize.evaluate.truth import TrueKeyframe, Truth
from scripts.programs.bench.truth.folding import fold_timed
from scripts.programs.bench.truth.places import places_row, places_table
from scripts.programs.bench.truth.walls import Walls, _walled, world_names, world_walls
from scripts.programs.bench.truth.worlds import Case
from tests.programs.truth_cases import trial_generator
from tests.support.envelopes import envelope
from tests.support.folds import accepted
from tests.support.maps import drawn_map

HALVES = drawn_map("######### #...#...# #...#...# #...#...# #########", 1.0, (-1.0, -2.0, 0.0))


def two_rooms_case() -> Case:
    """A robot that drives through both rooms of `HALVES`, through the wall."""
    spots = [(0.9 + 0.5 * k, 0.5) for k in range(5)] + [(4.1 + 0.5 * k, 0.5) for k in range(5)]
    events = [accepted(envelope(k, x, y)) for k, (x, y) in enumerate(spots)]
    truth = {
        ("run-a", k): TrueKeyframe(
            run_id="run-a", keyframe_id=k, room="west" if x < 3.5 else "east", instances=[]
        )
        for k, (x, _) in enumerate(spots)
    }
    return Case("rover two_rooms", CameraConstants(), events, Truth(truth), {}, "run-a", {})


def test_the_walls_of_a_generated_building_lie_where_its_rooms_end() -> None:
    generator = trial_generator()
    assert "tb3_house" in world_names(generator)
    house, shop = (world_walls(generator, world) for world in ("tb3_house", "aws_bookstore"))
    assert house.walled > 0.7, "its rooms have walls"
    assert shop.walled < 0.2, "its rooms are zones of one hall"
    assert house.map.resolution == generator.RES
    assert set(np.unique(house.map.cells).tolist()) == {0, 100}
    house.map.encode()


def test_a_border_is_walled_where_a_wall_is_near() -> None:
    rooms = np.zeros((4, 6), int)
    rooms[:, 3:] = 1
    walls = np.zeros((4, 6), bool)
    assert _walled(rooms, walls, 0.1) == 0.0
    walls[1, 3] = True
    assert _walled(rooms, walls, 0.3) == 0.75
    assert _walled(np.zeros((4, 6), int), walls, 0.1) == 0.0


def test_places_with_walls_are_one_more_rule_of_the_table() -> None:
    case = two_rooms_case()
    rules = {"page": Settings(), "rooms": Settings(places="rooms")}
    row = places_row(case, rules, Walls(HALVES, 0.9))
    assert list(row.rules) == ["page", "rooms", "walls"]
    assert row.rules["walls"].v_measure == 1.0 > row.rules["page"].v_measure
    table = places_table([row, row])
    assert "V walls" in table
    assert "rooms have walls" in table
    assert "rooms have walls" not in places_table([places_row(case, rules)] * 2)


def test_a_map_comes_before_the_first_keyframe() -> None:
    case = two_rooms_case()
    view, _ = fold_timed(case.events, Settings(), HALVES)
    assert view.map is not None
    assert view.map.offset == 0
    assert view.keyframes[0].offset == 1
