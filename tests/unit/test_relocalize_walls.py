"""Walls in re-localisation: lines of sight, poses in walls, and what they change in an answer."""

import functools
import math

import numpy as np
import pytest

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.deltas import MapGiven
from projections.fold.occupancy import wall_blocks
from projections.localize.relocalize import ExactIndex, QuestionCrop, rank
from projections.localize.relocalize.ground import _AT_POSE_M, _AT_THING_M, WallMap
from tests.support.envelopes import detection, envelope
from tests.support.folds import fold
from tests.support.maps import drawn_map

RNG = np.random.default_rng(3)


def _random_map(yaw: float) -> OccupancyMap:
    cells = np.zeros((60, 80), np.uint8)
    for _ in range(8):
        row, column = RNG.integers(0, 60), RNG.integers(0, 80)
        cells[row, column : column + 12] = 100
        cells[row : row + 12, column] = 100
    return OccupancyMap(None, 0.1, (-2.0, 1.0, yaw), "s", cells)


@functools.cache
def _blocks(given: OccupancyMap) -> tuple[int, np.ndarray]:
    return wall_blocks(given)


def _is_in_wall(given: OccupancyMap, x: float, y: float) -> bool:
    """One position, looked up as the map's fields say."""
    side, blocks = _blocks(given)
    dx, dy = x - given.origin[0], y - given.origin[1]
    cos, sin = math.cos(given.origin[2]), math.sin(given.origin[2])
    column = math.floor((cos * dx + sin * dy) / (side * given.resolution))
    row = math.floor((cos * dy - sin * dx) / (side * given.resolution))
    return 0 <= row < len(blocks) and 0 <= column < len(blocks[0]) and bool(blocks[row, column])


def _meets_wall(given: OccupancyMap, a: np.ndarray, b: np.ndarray, step_m: float) -> bool:
    """Every so many metres from a position to a thing, but for both ends."""
    length = math.dist(a, b)
    at = np.arange(_AT_POSE_M, length - _AT_THING_M, step_m)
    return any(_is_in_wall(given, *(a + (b - a) * (d / length))) for d in at.tolist())


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_lines_of_sight_are_those_of_a_slow_walk(yaw: float) -> None:
    given = _random_map(yaw)
    walls = WallMap(given)
    things, xy = RNG.uniform(-9, 12, (8, 2)), RNG.uniform(-9, 12, (20, 2))
    asked = RNG.random((8, 20)) < 0.7
    found = walls.hides(things, xy, asked)
    assert not found[~asked].any()
    fine = np.array([[_meets_wall(given, p, t, 0.03) for p in xy] for t in things])
    assert 10 < fine[asked].sum() < asked.sum() - 10, "some are hidden, some are not"
    assert not (found & ~fine)[asked].any(), "nothing is hidden that is in sight"
    missed = (fine & ~found & asked).sum()
    assert missed <= 0.1 * fine[asked].sum(), "corners that a line only grazes may be missed"


def test_a_thing_behind_a_wall_is_hidden_and_one_at_it_is_not() -> None:
    wall = drawn_map("#" * 60, 0.1, (0.0, 2.0, 0.0))  # y from 2 to 2.1
    walls = WallMap(wall)
    here = np.array([(3.0, 0.5)])
    things = np.array([(3.0, 2.05), (3.0, 2.3), (3.0, 4.0), (3.0, 1.0), (12.0, 4.0)])
    hidden = walls.hides(things, here, np.ones((5, 1), bool))
    assert hidden[:, 0].tolist() == [False, False, True, False, False]
    assert walls.contains(np.array([(3.0, 2.05), (3.0, 2.2), (7.0, 2.05)])).tolist() == [
        True,
        False,
        False,
    ]


def test_walls_hide_nothing_without_landmarks_or_close_by() -> None:
    walls = WallMap(drawn_map("#" * 9, 0.1))
    spots = np.zeros((2, 2))
    assert not walls.hides(spots, spots, np.zeros((2, 2), bool)).any()
    assert not walls.hides(spots + 0.1, spots, np.ones((2, 2), bool)).any()


def test_an_answer_keeps_out_of_walls_and_does_not_look_through_them() -> None:
    """Two twins stand either side of a wall; the thing beside one of them is asked for, too."""
    documents = []
    for k in range(12):
        x = 0.4 * k
        seen = [detection("chair", [1.0, 0.2, 0.0], det_id=f"c{k}", bbox=[280, 150, 360, 250])]
        documents.append(envelope(k, x, 0.0, detections=seen))
    view = fold(documents).view
    crop = QuestionCrop(
        np.array([1.0, 0.2, 0.0], np.float32), (280.0, 150.0, 360.0, 250.0), "chair"
    )
    open_ = rank([crop], ExactIndex(view).search([crop]))
    room = OccupancyMap(None, 0.1, (-3.0, -3.0, 0.0), "s", np.zeros((60, 110), np.uint8))
    view.maps[None] = MapGiven(0, room)
    same = rank([crop], ExactIndex(view).search([crop]))
    assert same == open_, "a map without walls changes nothing"
    assert open_.pose is not None
    cells = np.zeros((60, 110), np.uint8)
    column = int((open_.pose.x + 3.0) / 0.1)
    cells[:, column - 3 : column + 4] = 100
    view.maps[None] = MapGiven(0, OccupancyMap(None, 0.1, (-3.0, -3.0, 0.0), "s", cells))
    index = ExactIndex(view)
    walled = rank([crop], index.search([crop]))
    assert walled.pose is not None
    assert walled.hypotheses is not None
    assert open_.hypotheses is not None
    inside = [
        float(found.weights[WallMap(view.maps[None].map).contains(found.poses[:, :2])].sum())
        for found in (open_.hypotheses, walled.hypotheses)
    ]
    assert inside[1] < 0.5 * inside[0]
    assert rank([crop], index.search([crop])) == walled
