"""Which of the weighed positions is the answer, beside loops that add up the expected errors."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.deltas import ObservationOrdinal
from projections.localize.relocalize import Match, QuestionCrop
from projections.localize.relocalize.pose import (
    MAX_ERROR_M,
    PLAIN_NEAREST,
    PLAIN_SHARE,
    least_error,
    stood_at,
)
from projections.localize.relocalize.question import QuestionView

Place = tuple[float, float]
PLACES = st.tuples(st.integers(-40, 40), st.integers(-40, 40)).map(
    lambda at: (at[0] * 0.35, at[1] * 0.35)
)


def expected_error(
    at: Place, cells: list[Place], weights: list[float], stood: list[Place]
) -> float:
    error = sum(
        weight * min(math.dist(at, cell), MAX_ERROR_M)
        for cell, weight in zip(cells, weights, strict=True)
    )
    if not stood:
        return error
    plain = sum(min(math.dist(at, each), MAX_ERROR_M) for each in stood) / len(stood)
    return (1.0 - PLAIN_SHARE) * error + PLAIN_SHARE * plain


@given(
    st.lists(st.tuples(PLACES, st.integers(1, 100)), min_size=1, max_size=12),
    st.lists(PLACES, max_size=12),
)
def test_the_answer_has_the_least_expected_error(
    weighed: list[tuple[Place, int]], stood: list[Place]
) -> None:
    cells = [cell for cell, _ in weighed]
    total = sum(weight for _, weight in weighed)
    weights = [weight / total for _, weight in weighed]
    best = least_error(
        np.array(cells), np.array(weights), np.array(stood, dtype=np.float64).reshape(-1, 2)
    )
    errors = [expected_error(cell, cells, weights, stood) for cell in cells]
    assert errors[best] <= min(errors) + 1e-9


def test_the_plain_baseline_decides_between_spots_of_about_the_same_weight_only() -> None:
    cells = np.array([(0.0, 0.0), (20.0, 0.0)])
    stood = np.array([(20.0, 0.5)] * 10)
    for share, expected in ((0.5, 1), (0.55, 1), (0.7, 0), (0.95, 0)):
        assert least_error(cells, np.array((share, 1.0 - share)), stood) == expected


def match(number: int, x: float | None) -> Match:
    pose = None if x is None else (x, -x, 0.0)
    return Match(ObservationOrdinal(number), f"d{number}", "r", 0.9, pose, None, "cup")


def test_robots_stood_where_the_nearest_observations_of_crops_with_a_look_are_from() -> None:
    look = QuestionCrop(np.ones(4, dtype=np.float32), None, "cup")
    named = QuestionCrop(None, None, "cup")
    rows = [
        [match(n, None if n == 2 else float(n)) for n in range(15)],
        [match(n, 100.0) for n in range(3)],
        [match(n, 50.0) for n in range(2)],
    ]
    views = [QuestionView(0.0, 0.0, 0.0, (look, named)), QuestionView(0.1, 0.0, 0.0, (look,))]
    found = [tuple(each) for each in stood_at(views, rows).tolist()]
    first = [(float(n), -float(n)) for n in range(PLAIN_NEAREST) if n != 2]
    assert found == [*first, (50.0, -50.0), (50.0, -50.0)]
    assert stood_at([], []).shape == (0, 2)
