"""Whether two halves of a thing's views disagree more than independent errors would."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from projections.fold.deltas import Pose
from projections.fold.evidence import EvidenceConstants
from projections.fold.exact import metres_to_um
from projections.localize.calibrate.qualified_things import Row, inflation, qualified, sightings_of
from projections.localize.calibrate.rounds import read
from tests.support.known_worlds import Known, rows_of
from tests.support.thorough import stride

KNOWN = Known()
ERRORS = (KNOWN.bearing_rad, 0.12, KNOWN.pose_m)


def _inflation(rows: list[Row]) -> float:
    seen = sightings_of(rows)
    return inflation(qualified(seen, *ERRORS), seen, *ERRORS)


def _moved(rows: list[Row], shift: Callable[[Row], tuple[float, float]]) -> list[Row]:
    moved = []
    for row in rows:
        x, y = shift(row)
        pose = Pose(
            row.pose.x_um + metres_to_um(x), row.pose.y_um + metres_to_um(y), row.pose.yaw_rad
        )
        moved.append(row._replace(pose=pose))
    return moved


@pytest.mark.parametrize("seed", range(1, 5, stride(4)))
def test_independent_errors_need_no_inflation(seed: int) -> None:
    assert _inflation(rows_of(Known(seed=seed))) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_errors_that_were_taken_for_too_small_do() -> None:
    rows = rows_of(Known(bearing_rad=2 * KNOWN.bearing_rad, pose_m=2 * KNOWN.pose_m))
    assert _inflation(rows) == pytest.approx(4.0, rel=0.25)


@pytest.mark.slow
def test_a_run_that_is_off_as_a_whole_does() -> None:
    """Residuals about one position hardly show it: the two runs differ by 0.4 m."""
    rows = rows_of(KNOWN)
    shifted = _moved(rows, lambda row: (0.4 * row.run, 0.0))
    assert _inflation(shifted) > 3.0
    prior = EvidenceConstants()
    poses = [read(sightings_of(each), prior, prior).constants.pose_m for each in (rows, shifted)]
    assert poses[1] > 1.7 * poses[0]


@pytest.mark.slow
def test_boxes_that_show_the_near_side_of_a_thing_do() -> None:
    """Every view errs by 0.3 m to a side that depends on where it is taken from."""
    rows = rows_of(KNOWN)

    def aside(row: Row) -> tuple[float, float]:
        left = row.pose.yaw_rad + math.pi / 2.0
        size = 0.3 if math.cos(row.pose.yaw_rad) > 0.0 else -0.3
        return size * math.cos(left), size * math.sin(left)

    assert _inflation(_moved(rows, aside)) > 1.7


@pytest.mark.slow
def test_many_views_of_a_thing_inflate_errors_to_a_bound() -> None:
    """An estimate of the fold rests on so many views at most, however many there are."""
    known = Known(things=24, looks=40)
    rows = rows_of(known)
    off = _moved(rows, lambda row: (0.15 * row.run, 0.0))
    again = [row._replace(picture=row.picture + 100_000 * copy) for copy in range(6) for row in off]
    assert _inflation(again) < 1.3 * _inflation(off)


def test_nothing_to_split_says_nothing() -> None:
    assert _inflation([]) == 1.0
    few = rows_of(Known(things=1, looks=5))
    assert _inflation(few) == 1.0


def test_few_things_are_hardly_believed() -> None:
    wrong = {"bearing_rad": 3 * KNOWN.bearing_rad, "pose_m": 3 * KNOWN.pose_m}
    few, many = (_inflation(rows_of(Known(things=n, **wrong))) for n in (2, 60))  # type: ignore[arg-type]
    assert 1.0 <= few < many
    assert np.log(few) < 0.6 * np.log(many)
