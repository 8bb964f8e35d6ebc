"""Session shifts: which runs have one, how large it is, and which runs stay open."""

import math

import numpy as np
import pytest

from projections.relocalize import Camera, Crop, Match
from projections.relocalize.landmarks import crop_evidence
from projections.relocalize.model import MODEL
from projections.relocalize.sessions import (
    RemainingShifts,
    apply_remaining_shifts,
    remaining_shifts,
    session_shifts,
    subtract_shifts,
)


def row(**runs: list[float]) -> list[Match]:
    """A crop's matches from the similarities with each run, most similar first."""
    pairs = sorted(((s, run) for run, found in runs.items() for s in found), reverse=True)
    return [
        Match(i, f"d{i}", run, s, (0.0, 0.0, 0.0), None, "cup") for i, (s, run) in enumerate(pairs)
    ]


def test_each_run_has_a_shift_of_its_own() -> None:
    shifts = session_shifts([row(own=[0.93, 0.92, 0.91], other=[0.88, 0.87, 0.86])], MODEL)
    assert shifts == {"own": pytest.approx(0.91 - MODEL.usual_third), "other": 0.0}


def test_a_runs_shift_is_the_largest_over_all_crops() -> None:
    rows = [row(own=[0.85, 0.84, 0.83]), row(own=[0.92, 0.915, 0.91], other=[0.8])]
    assert session_shifts(rows, MODEL)["own"] == pytest.approx(0.91 - MODEL.usual_third)


def test_a_single_identical_crop_makes_no_shift() -> None:
    assert session_shifts([row(own=[1.0, 0.87, 0.86])], MODEL) == {"own": 0.0}


def test_a_run_with_fewer_than_three_matches_has_no_shift() -> None:
    rows = [row(own=[1.0, 0.95], other=[0.87, 0.86, 0.85])] * 2
    shifts = session_shifts(rows, MODEL)
    assert shifts == {"own": 0.0, "other": 0.0}
    assert subtract_shifts(rows[0], shifts) == rows[0]


def test_only_the_own_runs_matches_are_shifted_and_the_order_follows() -> None:
    crop = row(own=[0.9375, 0.875], other=[0.9, 0.8125])
    moved = subtract_shifts(crop, {"own": 0.0625, "other": 0.0})
    assert [(m.run_id, m.similarity) for m in moved] == [
        ("other", 0.9),
        ("own", 0.875),
        ("own", 0.8125),
        ("other", 0.8125),
    ]
    assert moved[2].observation < moved[3].observation


def test_the_remaining_shift_is_a_sessions_less_the_subtracted() -> None:
    crop = row(own=[0.9], other=[0.8])
    found = remaining_shifts(crop, {"own": 0.03, "other": 0.0, "else": 0.1}, MODEL)
    assert found.run[0] != found.run[1]
    assert found.subset(np.array([0])).run.tolist() == [found.run[0]]
    assert found.shift.tolist() == pytest.approx([MODEL.session - 0.03, MODEL.session])


def test_a_run_that_is_too_similar_from_behind_is_the_own_session() -> None:
    """Seen from the first direction run 1 is as much too similar as a session makes it."""
    run = np.array([1, 0, 1, 0, 1, 0])
    error = np.array([[MODEL.session * (r == 1) for r in run], [-0.02] * 6])
    less, price = apply_remaining_shifts(
        error, RemainingShifts(run, np.full(6, MODEL.session)), MODEL
    )
    assert less[0].tolist() == pytest.approx([0.0] * 6)
    assert less[1].tolist() == error[1].tolist()
    assert price.tolist() == [MODEL.session_price, 0.0]


def test_a_run_whose_shift_is_fully_subtracted_is_unchanged() -> None:
    error = np.full((3, 4), 0.05)
    less, price = apply_remaining_shifts(
        error, RemainingShifts(np.array([0, 0, 1, 1]), np.zeros(4)), MODEL
    )
    assert less.tolist() == error.tolist()
    assert price.tolist() == [0.0] * 3


def looks_at_the_origin(number: int, run: str, x: float, y: float, similarity: float) -> Match:
    """A thing 1 m high at the origin, seen in the middle of the picture."""
    half = 0.5 * 462.0 / math.hypot(x, y)
    box = (320.0 - half, 200.0 - half, 320.0 + half, 200.0 + half)
    return Match(number, f"d{number}", run, similarity, (x, y, math.atan2(-y, -x)), box, "cup")


def test_two_runs_that_saw_opposite_sides_of_a_thing_make_one_landmark_that_fits_in_front() -> None:
    """The own session saw it from behind, as similar as another session's from the flank.

    Were all views of one run, the similarities would fit from neither side.
    """
    behind = MODEL.floor + MODEL.side * math.exp(-2.0 * MODEL.kappa) + MODEL.session
    front = MODEL.floor + MODEL.side
    wide = (-0.6, -0.3, 0.0, 0.3, 0.6)
    crop = Crop(np.ones(4, dtype=np.float32) / 2, (260.0, 140.0, 380.0, 260.0))
    tables = {}
    for own in ("own", "other"):
        seen = [looks_at_the_origin(i, "other", 2.5, y, front) for i, y in enumerate(wide)]
        seen += [looks_at_the_origin(9 + i, own, -2.5, y, behind) for i, y in enumerate(wide)]
        found = crop_evidence([crop], [seen], Camera(), MODEL)[0].landmarks
        assert [len(landmark.members) for landmark in found] == [10]
        tables[own] = found[0].table
    assert tables["own"][0] > tables["other"][0] + 1.0
    assert abs(math.remainder(int(tables["own"].argmax()), len(tables["own"]))) <= 2
