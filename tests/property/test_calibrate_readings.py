"""Constants read off worlds that were made with them."""

import dataclasses
import math

import numpy as np
import pytest

from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import CameraConstants
from projections.localize.calibrate.qualified_things import sightings_of
from projections.localize.calibrate.readings import Reading
from projections.localize.calibrate.rounds import Round, read
from tests.support.known_worlds import CAMERA, Known, rows_of
from tests.support.thorough import mostly_slow, rounds

PRIOR = EvidenceConstants()
WORLDS = {
    "near, sight": Known(),
    "far, heading": Known(
        range_m=4.5,
        range_spread=0.25,
        bearing_rad=0.06,
        pose_m=0.05,
        size_spread=0.3,
        different=0.1,
        same_class=0.3,
        same_back=0.6,
        same_side=0.3,
        same_kappa=4.0,
        session_shift=0.2,
        side_by="heading",
        looks=30,
        seed=2,
    ),
    "alike": Known(different=0.75, same_class=0.3, same_back=0.7, same_side=0.1, seed=3),
}


def _calibrated(known: Known) -> Round:
    seen = sightings_of(rows_of(known))
    return read(seen, read(seen, PRIOR, PRIOR).constants, PRIOR)


def _by_name(found: Round) -> dict[str, Reading]:
    return {each.name: each for each in (*found.readings, *found.sizes)}


@pytest.fixture(scope="module", params=mostly_slow(sorted(WORLDS, key="far, heading".__ne__)))
def world(request: pytest.FixtureRequest) -> tuple[Known, Round]:
    known = WORLDS[request.param]
    return known, _calibrated(known)


def _seen(found: Round, name: str) -> float:
    value = _by_name(found)[name].seen
    assert isinstance(value, float)
    return value


def test_nearly_every_thing_qualifies(world: tuple[Known, Round]) -> None:
    known, found = world
    assert 0.98 * known.things <= found.things <= known.things
    assert found.observations > 5 * known.things


def test_ranges_and_errors_are_recovered(world: tuple[Known, Round]) -> None:
    known, found = world
    assert _seen(found, "range_m") == pytest.approx(known.range_m, rel=0.05)
    assert _seen(found, "range_spread") == pytest.approx(known.range_spread, rel=0.1)
    assert _seen(found, "bearing_rad") == pytest.approx(known.bearing_rad, rel=0.25)
    assert _seen(found, "pose_m") == pytest.approx(known.pose_m, rel=0.15, abs=0.03)


def test_sizes_are_recovered(world: tuple[Known, Round]) -> None:
    known, found = world
    assert list(found.constants.sizes_m) == [f"class {i}" for i in range(4)]
    for index, size in enumerate(known.sizes_m):
        assert found.constants.sizes_m[f"class {index}"] == pytest.approx(
            size, rel=3.2 * known.size_spread / (known.things / 4) ** 0.5
        )
    assert _seen(found, "size_spread") == pytest.approx(known.size_spread, rel=0.2)


def test_looks_are_recovered(world: tuple[Known, Round]) -> None:
    known, found = world
    assert _seen(found, "different") == pytest.approx(known.different, abs=0.02)
    assert _seen(found, "same_class") == pytest.approx(known.same_class, abs=0.03)
    assert _seen(found, "session_shift") == pytest.approx(known.session_shift, abs=0.02)
    constants = found.constants
    assert constants.side_by == known.side_by
    assert constants.same_kappa == known.same_kappa
    assert _seen(found, "same_back") == pytest.approx(known.same_back, abs=0.03)
    assert _seen(found, "same_side") == pytest.approx(known.same_side, abs=0.03)


def test_values_are_drawn_towards_the_priors_by_their_counts(world: tuple[Known, Round]) -> None:
    named = _by_name(world[1])
    for name in ("range_m", "range_spread", "bearing_rad", "pose_m", "size_spread"):
        each, prior = named[name], getattr(PRIOR, name)
        share = each.count / (each.count + 100)
        assert isinstance(each.value, float)
        assert isinstance(each.seen, float)
        expected = math.exp(share * math.log(each.seen) + (1 - share) * math.log(prior))
        assert each.value == pytest.approx(expected, rel=2e-3)
        assert each.prior == prior
    same = named["same_class"]
    assert isinstance(same.seen, float)
    share = same.count / (same.count + 100)
    assert same.value == pytest.approx(share * same.seen + (1 - share) * PRIOR.same_class, abs=2e-3)


def test_few_observations_leave_the_priors_nearly_as_they_are() -> None:
    few = _calibrated(Known(range_m=8.0, things=2, looks=4, same_back=0.8, same_side=0.1))
    named = _by_name(few)
    assert 0 < named["range_m"].count <= 16
    assert isinstance(named["range_m"].seen, float)
    assert named["range_m"].seen > 6.0
    assert PRIOR.range_m < few.constants.range_m < PRIOR.range_m + 1.0
    assert few.constants.same_back == pytest.approx(PRIOR.same_back, abs=0.05)
    assert few.constants.same_kappa == PRIOR.same_kappa
    assert few.constants.side_by == PRIOR.side_by


@pytest.mark.slow
def test_cut_boxes_have_an_error_of_their_own() -> None:
    """Every third box is cut at a side and its middle displaced by 0.15 rad."""
    known, focal = Known(), CAMERA.width_px / 2.0 / math.tan(math.radians(CAMERA.hfov_deg / 2.0))
    rows, rng = rows_of(known), np.random.default_rng(9)
    cut = []
    for index, row in enumerate(rows):
        if index % 3 == 0:
            left, top, right, bottom = row.bbox
            off = math.atan((400.0 - (left + right) / 2.0) / focal) + 0.15 * float(rng.normal())
            middle = max(400.0 - focal * math.tan(off), 2.0)
            row = row._replace(bbox=(0.0, top, 2.0 * middle, bottom))
        cut.append(row)
    seen = sightings_of(cut)
    found = read(seen, PRIOR, PRIOR)
    named = _by_name(found)
    assert named["bearing_cut_rad"].count == pytest.approx(len(rows) / 3, rel=0.1)
    assert named["bearing_rad"].count == pytest.approx(len(rows) * 2 / 3, rel=0.1)
    assert _seen(found, "bearing_rad") == pytest.approx(known.bearing_rad, rel=0.2)
    assert _seen(found, "bearing_cut_rad") == pytest.approx(0.15, rel=0.15)


def test_one_run_has_the_prior_s_session_shift() -> None:
    found = _calibrated(Known(runs=1, things=40))
    shift = _by_name(found)["session_shift"]
    assert (shift.value, shift.seen, shift.count) == (PRIOR.session_shift, None, 0)
    assert _by_name(found)["same_back"].count > 100


def test_one_class_has_no_scale_of_likeness() -> None:
    rows = [row._replace(class_name="chair") for row in rows_of(Known(things=30))]
    found = read(sightings_of(rows), PRIOR, PRIOR)
    named = _by_name(found)
    assert (named["different"].value, named["different"].count) == (None, 0)
    assert named["same_back"].seen is None
    assert named["range_m"].count > 100
    assert list(found.constants.sizes_m) == ["chair"]


def test_without_boxes_only_looks_of_different_things_are_read() -> None:
    rows = [row._replace(bbox=(5.0, 5.0, 5.0, 5.0)) for row in rows_of(Known(things=40))]
    found = read(sightings_of(rows), PRIOR, PRIOR)
    assert (found.things, found.observations, found.constants.sizes_m) == (0, 0, {})
    named = _by_name(found)
    assert {each.name for each in named.values() if each.seen is not None} == {
        "different", "different_spread", "same_class", "same_class_spread",
    }  # fmt: skip
    kept = found.constants.model_copy(
        update={name: getattr(PRIOR, name) for name in ("different", "different_spread")}
        | {name: getattr(PRIOR, name) for name in ("same_class", "same_class_spread")}
    )
    assert kept == PRIOR


def test_nothing_seen_leaves_every_prior() -> None:
    found = read(sightings_of([]), PRIOR, PRIOR)
    assert found.constants == PRIOR
    assert {each.count for each in found.readings} == {0}
    assert found.camera == ()


def test_the_numbers_of_things_do_not_matter() -> None:
    rows = rows_of(Known(things=rounds(40, 16)))
    other = [row._replace(thing=997 - 7 * row.thing) for row in rows]
    assert read(sightings_of(rows), PRIOR, PRIOR) == read(sightings_of(other), PRIOR, PRIOR)


def test_a_wrong_field_of_view_is_noticed() -> None:
    known = Known(bearing_rad=0.02, pose_m=0.03, side_by="heading", looks=rounds(30, 15))
    rows = rows_of(known)
    assert read(sightings_of(rows), PRIOR, PRIOR).camera == ()
    for hfov, sign in ((100.0, 1.0), (62.0, -1.0)):
        wrong = CameraConstants(hfov_deg=hfov, width_px=800.0, height_px=600.0)
        found = read(sightings_of(row._replace(camera=wrong) for row in rows), PRIOR, PRIOR)
        (fault,) = found.camera
        assert fault.name == "hfov"
        assert isinstance(fault.value, float)
        assert math.copysign(1.0, fault.value) == sign


@pytest.mark.slow
def test_a_turned_camera_is_noticed() -> None:
    found = _calibrated(Known(turned_rad=0.1, looks=20))
    assert [fault.name for fault in found.camera] == ["yaw_rad"]
    assert found.camera[0].value == pytest.approx(0.1, abs=0.03)


def test_boxes_of_another_picture_are_counted() -> None:
    rows = rows_of(Known(things=10))
    assert sightings_of(rows).beyond == 0
    small = CameraConstants(hfov_deg=80.0, width_px=400.0, height_px=300.0)
    assert sightings_of(row._replace(camera=small) for row in rows).beyond > len(rows) / 3


def test_the_constants_hold_what_was_read(world: tuple[Known, Round]) -> None:
    found = world[1]
    constants = found.constants.model_dump()
    for each in found.readings:
        assert constants[each.name] == each.value
    assert {f"sizes_m.{name}" for name in constants["sizes_m"]} == {e.name for e in found.sizes}
    fields = {field for field in EvidenceConstants.model_fields if field != "sizes_m"}
    assert {each.name for each in found.readings} == fields
    assert dataclasses.is_dataclass(found)
