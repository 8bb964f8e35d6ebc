"""The parts of a calibration against slow, obvious oracles."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.deltas import Pose
from projections.fold.exact import metres_to_um, quantise
from projections.fold.settings import CameraConstants
from projections.localize.calibrate import likenesses, qualified_things, readings
from projections.localize.calibrate.qualified_things import Row, Sightings, sightings_of

CAMERA = CameraConstants(hfov_deg=90.0, width_px=800.0, height_px=600.0)
FOCAL = 400.0


def _row(picture: int = 0, thing: int = 0, **fields: Any) -> Row:
    look = quantise(np.array([1.0, 2.0], dtype=np.float32))
    row = Row(picture, 0, Pose(0, 0, 0.0), CAMERA, "cup", (395.0, 200.0, 405.0, 300.0), look, thing)
    return row._replace(**fields)


def _looking_at(
    x: float, y: float, spots: list[tuple[float, float]], turn: float = 0.0
) -> Sightings:
    """A thing at (x, y) in the middle of each picture."""
    rows = [
        _row(i, pose=Pose(metres_to_um(a), metres_to_um(b), math.atan2(y - b, x - a) + turn))
        for i, (a, b) in enumerate(spots)
    ]
    return sightings_of(rows)


def _qualified(seen: Sightings) -> list[qualified_things.QualifiedThing]:
    return qualified_things.qualified(seen, 0.05, 0.12, 0.08)


coordinates = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))


@given(st.lists(coordinates, min_size=2, max_size=7), coordinates)
def test_exactly_the_things_qualify_that_the_rule_names(
    spots: list[tuple[float, float]], thing: tuple[float, float]
) -> None:
    seen = _looking_at(*thing, spots)
    matrix = np.zeros((2, 2))
    for sight in seen.sight:
        along = np.array([math.cos(sight), math.sin(sight)])
        matrix += np.eye(2) - np.outer(along, along)
    crossing = float(np.linalg.eigvalsh(matrix)[0]) / len(spots)
    apart = max(math.dist(a, b) for a, b in itertools.combinations(spots, 2))
    if abs(crossing - 0.08) < 1e-6 or abs(apart - 0.8) < 1e-5:
        return  # rounding decides
    near = any(math.dist(spot, thing) < 0.25 for spot in spots)
    expected = len(spots) >= 3 and apart >= 0.8 and crossing >= 0.08
    found = _qualified(seen)
    if near and expected:
        return  # a bearing from the thing itself is none
    assert len(found) == expected
    for each in found:
        assert (each.x, each.y) == pytest.approx(thing, abs=1e-4)
        assert each.residual == pytest.approx(0.0, abs=1e-3)
        assert each.range == pytest.approx([math.dist(spot, thing) for spot in spots], abs=1e-4)


def test_one_bearing_of_another_thing_hardly_moves_the_position() -> None:
    spots = [(0.0, 0.0), (1.0, -1.0), (2.0, 0.0), (0.0, 2.0), (2.5, 2.5), (1.2, 2.8)]
    seen = _looking_at(1.0, 1.0, spots)
    seen.sight[3] += 0.9
    (found,) = _qualified(seen)
    assert (found.x, found.y) == pytest.approx((1.0, 1.0), abs=0.05)
    assert found.residual[3] == pytest.approx(0.9, abs=0.1)


def test_bearings_that_do_not_meet_are_no_thing() -> None:
    rng = np.random.default_rng(5)
    spots = [(float(a), float(b)) for a, b in rng.uniform(-3, 3, (12, 2))]
    seen = _looking_at(0.0, 0.0, spots)
    assert len(_qualified(seen)) == 1
    assert _qualified(_looking_at(0.0, 0.0, spots, turn=math.pi)) == []  # all behind the robot


def test_a_look_around_on_one_spot_is_no_triangulation() -> None:
    rng = np.random.default_rng(6)
    spots = [(float(a), float(b)) for a, b in rng.normal(0.0, 0.03, (24, 2))]
    assert _qualified(_looking_at(0.5, 0.5, spots)) == []


def test_leverages_of_a_position_add_up_to_its_two_coordinates() -> None:
    spots = [(0.0, 0.0), (2.0, 0.0), (0.0, 2.0), (2.0, 2.5), (1.0, -1.0)]
    (found,) = _qualified(_looking_at(1.0, 1.0, spots))
    assert found.leverage.sum() == pytest.approx(2.0, abs=1e-6)


@given(st.lists(st.integers(0, 9), max_size=60))
def test_pairs_in_pictures_are_all_pairs(pictures: list[int]) -> None:
    picture = np.array(pictures, dtype=np.int64)
    expected = {
        (i, j)
        for i, j in itertools.combinations(range(len(pictures)), 2)
        if pictures[i] == pictures[j] and pictures[i:j].count(pictures[i]) < 24
    }
    first, second = likenesses._pairs_in_pictures(picture)
    pairs = list(zip(first.tolist(), second.tolist(), strict=True))
    assert len(pairs) == len(set(pairs))
    assert {(min(p), max(p)) for p in pairs} == expected


@given(st.integers(0, 10_000), st.integers(2, 40))
def test_cosines_are_exact(seed: int, dim: int) -> None:
    rng = np.random.default_rng(seed)
    units = [quantise(rng.normal(size=dim).astype(np.float32)) for _ in range(4)]
    seen = sightings_of(_row(i, look=unit) for i, unit in enumerate(units))
    a, b = np.array([0, 1, 2, 3]), np.array([1, 2, 3, 3])
    exact = [
        sum(int(p) * int(q) for p, q in zip(units[i], units[j], strict=True))
        for i, j in zip(a, b, strict=True)
    ]
    assert seen.cosines(a, b).tolist() == [value / 2**40 for value in exact]


def test_boxes_become_bearings_and_heights() -> None:
    boxes = [
        (395.0, 200.0, 405.0, 300.0),  # in the middle
        (0.0, 100.0, 0.0 + 2 * 100.0, 200.0),  # cut at the left; its middle at 100 px
        (795.0, 0.0, 800.0, 300.0),  # cut at the right and at the top
        (100.0, 590.0, 120.0, 600.0),  # cut at the bottom
        (10.0, 10.0, 10.0, 20.0),  # empty
    ]
    seen = sightings_of(_row(bbox=box, pose=Pose(0, 0, 0.5)) for box in boxes)
    assert seen.off_axis[:3] == pytest.approx(
        [0.0, math.atan(300.0 / FOCAL), math.atan(-397.5 / FOCAL)]
    )
    assert seen.sight[1] == pytest.approx(0.5 + math.atan(0.75))
    assert seen.cut.tolist()[:4] == [False, True, True, False]
    assert seen.boxed.tolist() == [True, True, True, True, False]
    assert seen.height[:2] == pytest.approx([0.25, 0.25])
    assert np.isnan(seen.height[2:]).all()
    turned = CAMERA.model_copy(update={"yaw_rad": -0.2})
    assert sightings_of([_row(camera=turned)]).sight[0] == pytest.approx(-0.2)


def test_every_envelope_may_have_a_camera_of_its_own() -> None:
    wide = CameraConstants(hfov_deg=120.0, width_px=1600.0, height_px=600.0)
    rows = [_row(i, camera=(CAMERA, wide)[i % 2], bbox=(0.0, 9.0, 100.0, 99.0)) for i in range(6)]
    seen = sightings_of(rows)
    alone = [sightings_of([row]) for row in rows]
    assert seen.sight.tolist() == [each.sight[0] for each in alone]
    assert seen.height.tolist() == [each.height[0] for each in alone]


@given(st.floats(1e-6, 1e6), st.floats(0.01, 100.0), st.integers(1, 100_000))
def test_a_spread_lies_between_what_was_seen_and_the_prior(
    seen: float, prior: float, count: int
) -> None:
    value = readings.spread("x", seen, prior, count).value
    assert isinstance(value, float)
    low, high = sorted((max(seen, 0.001), max(prior, 0.001)))
    assert low * (1 - 1e-3) - 1e-4 <= value <= high * (1 + 1e-3) + 1e-4
    assert value >= 0.001


def test_nothing_seen_and_nonsense_seen_are_the_prior() -> None:
    for seen, count in ((5.0, 0), (math.nan, 10), (math.inf, 10), (0.0, 10), (-1.0, 10)):
        assert readings.spread("x", seen, 2.0, count) == readings.unread("x", 2.0)
    assert readings.level("x", math.nan, 0.3, 7) == readings.unread("x", 0.3)
    assert readings.level("x", -0.3, 0.3, 100).value == 0.0


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, 0.0), (1.23456, 1.235), (0.123456, 0.1235), (0.0012345, 0.0012), (12345.6, 12346.0)],
)
def test_numbers_are_rounded_to_four_digits(value: float, expected: float) -> None:
    assert readings.rounded(value) == expected
    assert readings.rounded(-value) == -expected
