"""The scores of ``scripts/bench_truth`` on cases small enough to score by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.deltas import ObjectEstimated, ObjectOrdinal, Pose
from scripts.programs.bench.truth.scoring import (
    ObjectScores,
    count_spots,
    is_inside,
    majorities,
    score_objects,
)
from scripts.programs.bench.truth.tables import HOUSE, Row, objects_table
from scripts.programs.bench.truth.worlds import TrueThing
from tests.programs.truth_cases import hand_made


def test_things_and_objects_with_one_observation_are_not_counted():
    view, truth = hand_made(
        [
            ("a", 0, 0, "A", 0),
            ("a", 0, 0, "A", 0),
            ("a", 0, 0, "B", 1),  # once: neither B nor its Object counts
            ("a", 0, 0, "C", 2),
            ("a", 0, 0, "C", 3),  # C twice, in two Objects with one observation each
            ("a", 0, 0, None, 4),
            ("a", 0, 0, None, 4),  # an Object of false positives counts as found
        ]
    )
    scores = score_objects(view, truth, {})
    assert (scores.instances, scores.objects, scores.ratio) == (2, 2, 1.0)


def test_perfect_objects_have_a_v_measure_of_one_whatever_the_false_positives():
    sights = [("a", 0, 0, "A", 0), ("a", 0, 0, "B", 1), ("a", 0, 0, "A", 0), ("a", 0, 0, None, 1)]
    scores = score_objects(*hand_made(sights), {})
    assert scores.v_measure == scores.adjusted_rand == 1.0


def test_one_object_for_two_things_has_no_homogeneity():
    sights = [("a", 0, 0, "A", 0), ("a", 0, 0, "B", 0)]
    assert score_objects(*hand_made(sights), {}).v_measure == 0.0


def test_half_split_thing_has_the_v_measure_computed_by_hand():
    # A, A in Objects 0 and 1; B, B in Object 2: homogeneity 1, completeness ln 2 / (1.5 ln 2).
    sights = [("a", 0, 0, i, o) for i, o in (("A", 0), ("A", 1), ("B", 2), ("B", 2))]
    assert score_objects(*hand_made(sights), {}).v_measure == pytest.approx(0.8)


def test_an_object_belongs_to_the_instance_of_most_of_its_observations():
    instances = ["B", "A", "A", None, None, None]
    view, truth = hand_made(
        [("a", 0, 0, i, 0) for i in instances]
        + [("a", 0, 0, "D", 1), ("a", 0, 0, "C", 1)]
        + [("a", 0, 0, None, 2)]
    )
    assert majorities(view, truth) == {0: "A", 1: "C"}


def test_spots_are_counted_where_no_earlier_spot_is_near():
    def at(*points: float) -> int:
        return count_spots(Pose(round(x * 1e6), 0, 0.0) for x in points)

    assert at() == 0
    assert at(0.0, 0.34, -0.34) == 1
    assert at(0.0, 0.35) == 2
    assert at(0.0, 0.3, 0.6, 0.9) == 2  # 0.3 is of the first spot, 0.6 the second, 0.9 is of it


def test_errors_are_of_objects_with_an_estimate_that_were_seen_from_two_spots():
    def estimated(thing: int, x: float, y: float, xx: float, yy: float) -> ObjectEstimated:
        at = round(x * 1e6), round(y * 1e6)
        return ObjectEstimated(
            20, ObjectOrdinal(thing), *at, round(xx * 1e12), 0, round(yy * 1e12), 9
        )

    view, truth = hand_made(
        [
            ("a", x, 0, i, o)
            for o, i in enumerate("ABCD")
            for x in ((0, 0.3) if i == "C" else (0, 1))
        ]
        + [("a", x, 0, None, 4) for x in (0, 1)],
        [
            estimated(0, 2.0, 1.3, 0.01, 0.04),  # 0.3 m off, σ 0.2: inside 2σ
            estimated(1, 3.3, 1.0, 0.01, 0.04),  # 0.3 m off, σ 0.1: outside
            estimated(2, 9.0, 9.0, 0.01, 0.01),  # from one spot only
            estimated(4, 9.0, 9.0, 0.01, 0.01),  # of no thing; D has no estimate
        ],
    )
    things = {i: TrueThing(i, x, 1.0) for i, x in zip("ABCD", (2.0, 3.0, 4.0, 5.0), strict=True)}
    scores = score_objects(view, truth, things)
    assert scores.errors_m == pytest.approx((0.3, 0.3))
    assert scores.inside_share == 0.5


offsets = st.floats(-3.0, 3.0)
spreads = st.floats(0.05, 2.0)


@given(offsets, offsets, spreads, spreads, st.floats(-math.pi, math.pi))
def test_the_ellipse_is_that_of_the_covariance_in_its_own_axes(dx, dy, a, b, angle):
    """Oracle: turn the offset into the axes and compare with the two standard deviations."""
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    covariance = turn @ np.diag([a * a, b * b]) @ turn.T
    u, v = turn.T @ [dx, dy]
    squared = (u / a) ** 2 + (v / b) ** 2
    if abs(squared - 4.0) > 1e-6:
        inside = is_inside(dx, dy, covariance[0, 0], covariance[0, 1], covariance[1, 1])
        assert inside == (squared < 4.0)


def test_a_covariance_without_area_is_refused():
    with pytest.raises(ValueError, match="no covariance"):
        is_inside(0.1, 0.1, 1.0, 1.0, 1.0)


def _row(name: str, v: float, errors: tuple[float, ...], inside: int) -> Row:
    page = ObjectScores(10, 14, 0.9, 0.5, (), 0)
    return Row(name, 100, page, ObjectScores(10, 11, v, 0.9, errors, inside), 2.0, 3.0)


def test_the_worst_line_stands_last_and_the_means_leave_the_house_out():
    rows = [
        _row("rover one", 0.8, (0.1, 0.2), 2),
        _row("rover two", 1.0, (0.4,), 0),
        _row(HOUSE, 0.5, (9.0,), 0),
    ]
    lines = objects_table(rows).splitlines()
    assert [line.split("  ")[0] for line in lines[1:4]] == ["rover two", "rover one", HOUSE]
    mean = lines[4].split()
    assert mean[:6] == ["mean", "200", "20", "28", "22", "1.40"]
    assert mean[6:] == ["1.10", "0.900", "0.900", "0.500", "0.900", "0.20", "0.67", "4.00", "1.50"]
    assert len(lines) == 5


def test_scores_of_nothing_are_shown_as_nothing():
    view, truth = hand_made([])
    nothing = score_objects(view, truth, {})
    assert math.isnan(nothing.ratio)
    assert math.isnan(nothing.median_error_m)
    assert math.isnan(nothing.inside_share)
    cells = objects_table([Row("r w", 0, nothing, nothing, 0.0, 0.0)]).splitlines()[1].split()
    assert cells[-4:] == ["-", "-", "0.00", "-"]
