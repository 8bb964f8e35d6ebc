"""Scores against scikit-learn's and against counting pairs by hand."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.localize.evaluate.scores import (
    agreement,
    auroc,
    calibration_floor,
    expected_calibration_error,
    percentile,
)

LABELS = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=40)
SCORES = st.lists(st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.75, 1.0]), max_size=15)


@pytest.mark.slow  # importing scikit-learn takes a second
@given(LABELS)
def test_agreement_is_sklearns(pairs: list[tuple[int, int]]) -> None:
    classes, clusters = [a for a, _ in pairs], [b for _, b in pairs]
    ours = agreement(classes, clusters)
    from sklearn import metrics

    h, c, v = metrics.homogeneity_completeness_v_measure(classes, clusters)
    assert (ours.homogeneity, ours.completeness) == pytest.approx((h, c), abs=1e-9)
    assert ours.v_measure == pytest.approx(v, abs=1e-9)
    if pairs:
        rand = metrics.adjusted_rand_score(classes, clusters)
        assert ours.adjusted_rand == pytest.approx(rand, abs=1e-9)


def test_agreement_of_a_place_that_was_split() -> None:
    """Two rooms, of which one is mapped as two places."""
    found = agreement([0, 0, 0, 0, 1, 1, 1, 1], [0, 0, 1, 1, 2, 2, 2, 2])
    assert (found.homogeneity, found.completeness) == pytest.approx((1.0, 2 / 3))
    assert found.v_measure == pytest.approx(0.8)
    assert found.adjusted_rand == pytest.approx(16 / 23)


@given(LABELS, st.randoms())
def test_agreement_does_not_depend_on_order(pairs: list[tuple[int, int]], random: object) -> None:
    shuffled = list(pairs)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    one, other = (agreement([a for a, _ in p], [b for _, b in p]) for p in (pairs, shuffled))
    assert one == other


@given(SCORES, SCORES)
def test_auroc_is_the_share_of_pairs_in_order(known: list[float], unknown: list[float]) -> None:
    value = auroc(known, unknown)
    if not known or not unknown:
        assert value is None
        return
    pairs = [(k > u) + 0.5 * (k == u) for k in known for u in unknown]
    assert value == pytest.approx(sum(pairs) / len(pairs))


def test_calibration_error_is_the_weighted_gap() -> None:
    confidence = [0.95, 0.95, 0.15, 0.15]
    assert expected_calibration_error(confidence, [True, False, False, False]) == pytest.approx(
        (2 * 0.45 + 2 * 0.15) / 4
    )
    assert expected_calibration_error([1.0], [True]) == 0.0
    assert expected_calibration_error([], []) == 0.0


def test_percentiles_interpolate() -> None:
    assert percentile([3.0, 1.0, 2.0], 0.5) == 2.0
    assert percentile([1.0, 2.0], 0.9) == pytest.approx(1.9)
    assert percentile([], 0.5) is None
    assert not math.isnan(percentile([5.0], 0.99) or 0.0)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=7))
def test_the_floor_is_the_mean_error_over_all_outcomes(p: list[float]) -> None:
    """Oracle: every combination of right and wrong, with its probability."""
    expected = 0.0
    for outcome in itertools.product([False, True], repeat=len(p)):
        chance = math.prod(c if y else 1.0 - c for c, y in zip(p, outcome, strict=True))
        expected += chance * expected_calibration_error(p, outcome)
    assert calibration_floor(p) == pytest.approx(expected, abs=1e-9)


def test_the_floor_falls_with_the_number_of_questions() -> None:
    assert calibration_floor([]) == calibration_floor([0.0, 1.0]) == 0.0
    many, few = calibration_floor([0.5] * 400), calibration_floor([0.5] * 4)
    assert many == pytest.approx(0.5 * math.sqrt(2 / math.pi / 400), rel=0.01)
    assert few == pytest.approx(0.1875)  # of 0 … 4 right: 0.5, 0.25, 0, 0.25, 0.5 by 1 4 6 4 1
