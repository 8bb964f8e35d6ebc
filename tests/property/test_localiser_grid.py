"""Grids of positions against distances taken one by one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.localize.relocalize.appearance import DIRECTIONS
from projections.localize.relocalize.camera import Cue
from projections.localize.relocalize.ground import (
    cells_near,
    distinct,
    square_to_nearest,
)
from projections.localize.relocalize.landmarks import Landmarks, _spots
from projections.localize.relocalize.pose import likely_spots

_METRES = st.floats(-8.0, 8.0)
_POINTS = st.lists(st.tuples(_METRES, _METRES), min_size=1, max_size=8)
_NOTHING = Cue(np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1))


def landmarks(looks: list[float], spots: list[list[tuple[float, float]]]) -> Landmarks:
    """Landmarks with these ratios by looks, seen from these positions."""
    count = len(looks)
    starts = np.cumsum([0, *(len(each) for each in spots[:-1])])
    return Landmarks(
        np.zeros((count, 2)),
        np.zeros((count, 3)),
        np.repeat(np.array(looks)[:, None], DIRECTIONS, axis=1),
        _NOTHING,
        (_NOTHING, _NOTHING),
        np.array([spot for each in spots for spot in each]),
        starts,
        np.zeros(count),
    )


@given(_POINTS, st.floats(0.2, 2.0))
def test_every_position_within_reach_is_in_a_cell_and_no_cell_is_far(
    points: list[tuple[float, float]], reach: float
) -> None:
    cells, squared = cells_near(np.array(points), 0.7, reach)
    keys = {(round(x / 0.7), round(y / 0.7)) for x, y in cells.tolist()}
    assert len(keys) == len(cells)
    for x, y in points:
        for turn in range(8):
            there = x + 0.7 * reach * math.cos(turn), y + 0.7 * reach * math.sin(turn)
            nearest = min(math.dist(there, cell) for cell in cells.tolist())
            assert nearest <= 0.7  # half a cell's diagonal, and what the points are rounded by
    for cell, found in zip(cells.tolist(), squared.tolist(), strict=True):
        nearest = min(math.dist(cell, point) for point in points)
        assert nearest <= reach + 0.85
        assert found == pytest.approx(nearest**2, abs=1e-9)
    assert cells.tolist() == sorted(cells.tolist())
    expected = square_to_nearest(cells, np.array(points))
    assert squared.tolist() == pytest.approx(expected.tolist(), abs=1e-9)


_FLOORS = st.lists(
    st.tuples(st.integers(0, 200), _METRES, st.sampled_from([-9.9e6, 0.0, 9.9e6]), _METRES),
    min_size=1,
    max_size=6,
).map(lambda rows: [(floor * 1e8 + x, far + y) for floor, x, far, y in rows])


@given(_POINTS | _FLOORS)
def test_points_in_one_square_count_once(points: list[tuple[float, float]]) -> None:
    found = distinct(np.array(points), 0.175)
    expected = {(round(x / 0.175), round(y / 0.175)) for x, y in points}
    assert {(round(x / 0.175), round(y / 0.175)) for x, y in found.tolist()} == expected
    assert len(found) == len(expected)
    assert found.tolist() == sorted(found.tolist())


def test_few_crops_are_looked_for_at_all_their_landmarks() -> None:
    spots = [[(float(10 * k), 0.0)] for k in range(10)]
    marks = landmarks([1.0 + k for k in range(10)], spots)
    assert len(likely_spots([marks] * 3, 0.175)) == 10


def test_of_many_crops_each_is_looked_for_at_its_best_landmarks() -> None:
    many = []
    for crop in range(20):
        spots = [[(10.0 * k, 100.0 * crop)] for k in range(10)]
        many.append(landmarks([float(k != crop % 10) + 0.1 * k for k in range(10)], spots))
    found = {(round(x), round(y)) for x, y in likely_spots(many, 0.175).tolist()}
    assert len(found) == 3 * 20
    for crop in range(20):
        best = 8 if crop % 10 == 9 else 9
        assert any(abs(x - 10 * best) <= 1 and abs(y - 100 * crop) <= 1 for x, y in found)


def test_landmarks_that_look_alike_are_all_considered() -> None:
    """A class has no best Object."""
    many = [landmarks([4.0] * 30, [[(7.0 * k, 9.0 * c)] for k in range(30)]) for c in range(3)]
    assert len(likely_spots(many, 0.175)) == 90


def test_no_question_has_more_spots_than_six_hundred() -> None:
    spots = [[(3.0 * k, 5.0 * each) for k in range(64)] for each in range(20)]
    marks = landmarks([4.0] * 20, spots)
    assert 300 <= len(likely_spots([marks], 0.175)) <= 600


@given(st.lists(st.tuples(st.integers(0, 3), _METRES, _METRES), min_size=1, max_size=20))
def test_each_landmark_has_the_squares_that_it_was_seen_from(
    seen: list[tuple[int, float, float]],
) -> None:
    names = sorted({owner for owner, _, _ in seen})
    ordered = sorted((names.index(owner), x, y) for owner, x, y in seen)
    owners = np.array([owner for owner, _, _ in ordered])
    poses = np.array([(x, y, 0.0) for _, x, y in ordered])
    spots, starts = _spots(poses, owners)
    ends = [*starts[1:].tolist(), len(spots)]
    for owner, (start, end) in enumerate(zip(starts.tolist(), ends, strict=True)):
        found = [(round(x / 0.175), round(y / 0.175)) for x, y in spots[start:end].tolist()]
        expected = {(round(x / 0.175), round(y / 0.175)) for o, x, y in ordered if o == owner}
        assert sorted(found) == sorted(expected)
