"""Whatever a log holds, a calibration gives constants that the settings take."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from projections.fold.deltas import Pose
from projections.fold.evidence import EvidenceConstants
from projections.fold.exact import quantise
from projections.fold.settings import CameraConstants, CameraSettings
from projections.localize.calibrate.field_of_view import field_of_view
from projections.localize.calibrate.qualified_things import Row, sightings_of
from projections.localize.calibrate.readings import Reading
from projections.localize.calibrate.rounds import _bounded, read
from tests.support.thorough import examples

FAR_UM = 10**13
PIXELS = st.one_of(
    st.floats(-1e300, 1e300), st.floats(-100.0, 900.0), st.sampled_from([0.0, 640.0, 1e-9])
)
POSITIONS = st.one_of(st.integers(-FAR_UM, FAR_UM), st.integers(-5_000_000, 5_000_000))
CAMERAS = st.sampled_from(
    [
        CameraConstants(),
        CameraConstants(hfov_deg=1.0, width_px=1e6, height_px=1.0),
        CameraConstants(hfov_deg=170.0),
    ]
)
LOOKS = [
    quantise(np.array(look, dtype=np.float32))
    for look in ((1, 0, 0), (-1, 0, 0), (1, 1e-4, 0), (1, 0, 1e-4), (0, 1, 0), (0.5, 0.5, -0.7))
]


@st.composite
def rows(draw: st.DrawFn) -> list[Row]:
    """Few things and pictures, so that much qualifies; values from sane to absurd."""
    return [
        Row(
            picture=draw(st.integers(0, 20)),
            run=draw(st.integers(0, 2)),
            pose=Pose(draw(POSITIONS), draw(POSITIONS), draw(st.floats(-1e4, 1e4))),
            camera=draw(CAMERAS),
            class_name=draw(st.sampled_from(["cup", "chair"])),
            bbox=(draw(PIXELS), draw(PIXELS), draw(PIXELS), draw(PIXELS)),
            look=draw(st.sampled_from(LOOKS)),
            thing=draw(st.integers(0, 5)),
        )
        for _ in range(draw(st.integers(0, 40)))
    ]


@given(rows())
@settings(max_examples=examples(150), deadline=None)
def test_constants_are_always_such_as_the_settings_take(found: list[Row]) -> None:
    prior = EvidenceConstants()
    camera = field_of_view(found, CameraSettings(), prior)
    assert camera is None or CameraSettings(**camera.settings.model_dump()) == camera.settings
    last = read(sightings_of(found), prior, prior)
    EvidenceConstants.model_validate(last.constants.model_dump())
    for each in (*last.readings, *last.sizes):
        assert each.count >= 0
        if isinstance(each.value, float):
            assert math.isfinite(each.value)


_LIKENESSES = ("same_class", "same_back", "same_side", "session_shift")
_SPREADS = ("range", "size", "different", "same_class", "same")
BOUNDS = {
    **dict.fromkeys(("range_m", "pose_m", "sizes_m"), (0.001, 1000.0)),
    **dict.fromkeys(("bearing_rad", "bearing_cut_rad"), (0.001, 3.2)),
    **dict.fromkeys([f"{name}_spread" for name in _SPREADS], (0.001, 2.0)),
    **dict.fromkeys(_LIKENESSES, (-2.0, 2.0)),
    "same_kappa": (0.001, 100.0),
}


@pytest.mark.parametrize("name", BOUNDS)
def test_a_reading_beyond_what_the_settings_take_is_the_nearest_that_they_take(name: str) -> None:
    def constants(value: float) -> EvidenceConstants:
        given = {"cup": value} if name == "sizes_m" else value
        return EvidenceConstants.model_validate({name: given})

    for bound, beyond in zip(BOUNDS[name], (-1e9, 1e9), strict=True):
        for value, expected in ((beyond, bound), (bound, bound), (0.5, 0.5)):
            reading = Reading("sizes_m.cup" if name == "sizes_m" else name, value, value, 1.0, 9)
            found = _bounded(reading, name if name == "sizes_m" else None)
            assert (found.value, found.seen) == (expected, value)
        constants(bound)
        with pytest.raises(ValidationError):
            constants(beyond)


def test_every_constant_that_is_a_number_has_bounds() -> None:
    assert {*BOUNDS, "different", "side_by"} == set(EvidenceConstants.model_fields)


def test_looks_that_are_nearly_all_the_same_give_constants_too() -> None:
    camera, rng = CameraConstants(), np.random.default_rng(3)
    made = [
        Row(
            i // 2,
            i % 3,
            Pose(int(rng.integers(-3e6, 3e6)), int(rng.integers(-3e6, 3e6)), 0.0),
            camera,
            ("cup", "chair")[i % 2],
            (300.0, 100.0, 340.0, 200.0),
            LOOKS[(0, 0, 0, 0, 2, 1)[i % 6]],
            i % 4,
        )
        for i in range(200)
    ]
    prior = EvidenceConstants()
    EvidenceConstants.model_validate(read(sightings_of(made), prior, prior).constants.model_dump())


def test_things_that_are_always_in_the_middle_of_the_picture_give_constants_too() -> None:
    """Nothing can be said about the camera then: no bearing is off its axis."""
    rng = np.random.default_rng(4)
    made = []
    for i in range(300):
        x, y = (float(v) for v in rng.uniform(-3.0, 3.0, 2))
        pose = Pose(round(x * 1e6), round(y * 1e6), math.atan2(-y, -x))
        made.append(
            Row(i, i % 2, pose, CameraConstants(), "cup", (310.0, 150.0, 330.0, 250.0), LOOKS[0], 0)
        )
    prior = EvidenceConstants()
    found = read(sightings_of(made), prior, prior)
    assert (found.things, found.camera) == (1, ())
    assert found.observations == 300
    EvidenceConstants.model_validate(found.constants.model_dump())
