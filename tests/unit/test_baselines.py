"""The baselines without a ranking that every score is compared with."""

import statistics

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.model import RunId
from projections.fold.deltas import ObservationOrdinal
from projections.localize.evaluate.trials import NEAREST, best_cosine, plain_position
from projections.localize.relocalize import Match

Spot = tuple[float, float] | None


def _row(spots: list[Spot]) -> list[Match]:
    """Matches with the cosines 0.9, 0.89, … of robots that stood at ``spots``."""
    return [
        Match(
            ObservationOrdinal(n),
            f"d{n}",
            RunId("r"),
            0.9 - n / 100,
            None if spot is None else (*spot, 0.0),
            None,
            "chair",
        )
        for n, spot in enumerate(spots)
    ]


spots = st.none() | st.tuples(st.floats(-9, 9), st.floats(-9, 9))


@given(st.lists(st.lists(spots, max_size=14), max_size=3))
def test_the_plain_position_is_the_median_of_the_nearest_ones(rows: list[list[Spot]]) -> None:
    stood = [spot for row in rows for spot in row[:NEAREST] if spot is not None]
    found = plain_position([_row(row) for row in rows])
    if not stood:
        assert found is None
    else:
        assert found is not None
        assert abs(found[0] - statistics.median(x for x, _ in stood)) < 1e-9
        assert abs(found[1] - statistics.median(y for _, y in stood)) < 1e-9


def test_the_best_cosine_is_that_of_any_crop() -> None:
    assert best_cosine([_row([None])[1:], _row([None, None])[1:], _row([None])]) == 0.9
    assert best_cosine([_row([None, None])[1:]]) == 0.89
    assert best_cosine([[], []]) == -1.0
