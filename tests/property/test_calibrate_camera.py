"""The field of view of a camera that nothing states, of worlds whose camera is known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold.deltas import Pose
from projections.fold.evidence import EvidenceConstants
from projections.fold.exact import metres_to_um, quantise
from projections.fold.settings import CameraConstants, CameraSettings
from projections.localize.calibrate.field_of_view import (
    LEAST_THINGS,
    USUAL_DEG,
    USUAL_SPREAD_DEG,
    FieldOfView,
    field_of_view,
)
from projections.localize.calibrate.qualified_things import Row
from tests.support.thorough import examples, rounds

PRIOR = EvidenceConstants()
SIZED = CameraSettings(width_px=800.0, height_px=600.0)
LOOK = quantise(np.array([1.0, 2.0], dtype=np.float32))
BEARING_RAD, POSE_M, REACH_M = 0.02, 0.05, 5.0


def _seen(hfov_deg: float, *, things: int = 30, pictures: int = 120, seed: int = 1) -> list[Row]:
    """What a camera of 800 × 600 pixels shows of a room of 8 × 8 m; boxes end at the border."""
    rng = np.random.default_rng([seed, things])
    stand = rng.uniform(-4.0, 4.0, (things, 2))
    half = math.radians(hfov_deg) / 2.0
    focal = 400.0 / math.tan(half)
    rows = []
    for picture in range(pictures):
        spot, yaw = rng.uniform(-4.0, 4.0, 2), float(rng.uniform(-math.pi, math.pi))
        at = spot + rng.normal(0.0, POSE_M, 2)
        pose = Pose(metres_to_um(float(at[0])), metres_to_um(float(at[1])), yaw)
        for thing, (dx, dy) in enumerate(stand - spot):
            off = math.remainder(math.atan2(dy, dx) - yaw, 2.0 * math.pi)
            off += BEARING_RAD * float(rng.normal())
            far = math.hypot(dx, dy)
            if abs(off) > half or not 0.5 < far < REACH_M:
                continue
            middle, side = 400.0 - focal * math.tan(off), 0.3 * focal / far
            left, right = max(middle - side, 0.0), min(middle + side, 800.0)
            box = left, 200.0, right, min(400.0 + side, 600.0)
            rows.append(Row(picture, 0, pose, CameraConstants(), "cup", box, LOOK, thing))
    return rows


def _found(rows: list[Row], camera: CameraSettings = SIZED) -> FieldOfView:
    found = field_of_view(rows, camera, PRIOR)
    assert found is not None
    return found


@given(st.floats(45.0, 105.0), st.integers(1, 9))
@settings(max_examples=examples(30), deadline=None)
def test_it_is_found_within_its_error(hfov_deg: float, seed: int) -> None:
    found = _found(_seen(hfov_deg, seed=seed))
    assert abs(found.seen_deg - hfov_deg) < max(4.0 * found.seen_error_deg, 2.0)
    assert found.seen_error_deg < 3.0


def test_the_size_of_the_picture_is_the_extent_of_its_boxes_unless_it_is_stated() -> None:
    rows = _seen(80.0)
    stated, measured = _found(rows), _found(rows, CameraSettings(yaw_rad=0.0))
    assert not stated.measured_px
    assert measured.measured_px
    assert measured.settings == stated.settings
    assert (measured.settings.width_px, measured.settings.height_px) == (800.0, 600.0)


def test_a_turned_camera_has_the_same_field_of_view() -> None:
    turned = [
        row._replace(pose=Pose(row.pose.x_um, row.pose.y_um, row.pose.yaw_rad - 0.5))
        for row in _seen(80.0)
    ]
    found = _found(turned, SIZED.model_copy(update={"yaw_rad": 0.5}))
    assert found.seen_deg == pytest.approx(_found(_seen(80.0)).seen_deg, abs=0.1)


def test_the_value_is_drawn_towards_the_usual_one_by_precision() -> None:
    found = _found(_seen(100.0, things=8, pictures=60))
    own, usual = found.seen_error_deg**-2, USUAL_SPREAD_DEG**-2
    drawn = (own * found.seen_deg + usual * USUAL_DEG) / (own + usual)
    assert found.settings.hfov_deg == pytest.approx(drawn, abs=0.2)
    assert found.settings.hfov_error_deg == pytest.approx((own + usual) ** -0.5, abs=0.2)


def test_things_that_were_fused_wrongly_show_in_the_error() -> None:
    rows = _seen(80.0)
    mixed = [row._replace(thing=row.thing // 2 * 2) for row in rows]
    assert _found(mixed).seen_error_deg > 1.5 * _found(rows).seen_error_deg


def test_the_error_is_honest() -> None:
    true = 80.0
    found = [
        _found(_seen(true, things=12, pictures=60, seed=seed)) for seed in range(rounds(24, 12))
    ]
    off = np.array([(each.seen_deg - true) / each.seen_error_deg for each in found])
    assert float(np.mean(np.abs(off) < 2.0)) > 0.7
    assert float(np.median(np.abs(off))) > 0.2


def test_the_numbers_of_things_do_not_matter() -> None:
    rows = _seen(80.0)
    assert _found([row._replace(thing=997 - 7 * row.thing) for row in rows]) == _found(rows)


def test_few_things_and_things_in_the_middle_of_the_picture_say_nothing() -> None:
    few = [row for row in _seen(80.0) if row.thing < LEAST_THINGS - 1]
    middle = [row._replace(bbox=(390.0, 200.0, 410.0, 300.0)) for row in _seen(80.0)]
    for rows in ([], few, middle):
        assert field_of_view(rows, SIZED, PRIOR) is None
