"""Session shifts: which runs have one, how large it is, and what is left of the likenesses."""

import numpy as np
import pytest

from projections.localize.relocalize import Match
from projections.localize.relocalize.appearance import session_shifts, subtract_shifts
from projections.localize.relocalize.camera import Floats

USUAL, MOST = 0.7, 0.15


def row(**runs: list[float]) -> tuple[list[Match], Floats]:
    """A crop's matches from the likenesses with each run, most similar first."""
    pairs = sorted(((s, run) for run, found in runs.items() for s in found), reverse=True)
    matches = [
        Match(i, f"d{i}", run, s, (0.0, 0.0, 0.0), None, "cup") for i, (s, run) in enumerate(pairs)
    ]
    return matches, np.array([s for s, _ in pairs])


def shifts_of(*rows: tuple[list[Match], Floats]) -> dict[str, float]:
    return session_shifts(
        [matches for matches, _ in rows], [alike for _, alike in rows], USUAL, MOST
    )


def test_each_run_has_a_shift_of_its_own() -> None:
    shifts = shifts_of(row(own=[0.85, 0.82, 0.78], other=[0.7, 0.69, 0.68]))
    assert shifts == {"own": pytest.approx(0.08), "other": 0.0}


def test_a_runs_shift_is_the_largest_over_all_crops_and_at_most_that_of_a_session() -> None:
    rows = [row(own=[0.6, 0.59, 0.58]), row(own=[0.9, 0.82, 0.8], other=[0.5])]
    assert shifts_of(*rows)["own"] == pytest.approx(0.1)
    assert shifts_of(row(own=[0.99, 0.98, 0.97]))["own"] == pytest.approx(MOST)


def test_a_single_identical_crop_makes_no_shift() -> None:
    assert shifts_of(row(own=[1.0, 0.69, 0.68])) == {"own": 0.0}


def test_a_run_with_fewer_than_three_matches_has_no_shift() -> None:
    crop = row(own=[1.0, 0.95], other=[0.6, 0.59, 0.58])
    shifts = shifts_of(crop, crop)
    assert shifts == {"own": 0.0, "other": 0.0}
    assert subtract_shifts(*crop, shifts).tolist() == crop[1].tolist()


def test_only_the_own_runs_likenesses_are_shifted() -> None:
    matches, likeness = row(own=[0.9375, 0.875], other=[0.9, 0.8125])
    less = subtract_shifts(matches, likeness, {"own": 0.0625, "other": 0.0})
    assert [(m.run_id, s) for m, s in zip(matches, less.tolist(), strict=True)] == [
        ("own", 0.875),
        ("other", 0.9),
        ("own", 0.8125),
        ("other", 0.8125),
    ]
