"""When a map is too thin for its answers to be trusted."""

import numpy as np
import pytest

from eventsrc.envelope.model import RunId
from projections.fold.deltas import ObservationOrdinal
from projections.localize.relocalize import NEIGHBOURS, Match, QuestionCrop, rank
from projections.localize.relocalize.candidates import MapCandidates
from projections.localize.relocalize.certainty import thinness

CROP = QuestionCrop(np.ones(1, dtype=np.float32))


def _row(spots: list[float | None], first: int = 0) -> tuple[Match, ...]:
    """Matches of observations first, first + 1, … made from these x."""
    return tuple(
        Match(
            ObservationOrdinal(first + n),
            f"d{first + n}",
            RunId("r"),
            0.9 - n / 1000,
            None if x is None else (x, 0.0, 0.0),
            None,
            "chair",
        )
        for n, x in enumerate(spots)
    )


FULL: list[float | None] = [0.4 * (n % 7) for n in range(NEIGHBOURS)]


def test_a_map_with_enough_of_both_is_not_thin() -> None:
    assert thinness([CROP], [_row(FULL)]) is None
    assert thinness([CROP, CROP], [_row(FULL[:3]), _row(FULL)]) is None


@pytest.mark.parametrize(
    ("spots", "says"),
    [
        ([], "0 observations from 0 spots"),
        ([0.0], "1 observation from 1 spot"),
        ([0.0, 0.2, 0.5, None], "4 observations from 2 spots"),
        (FULL[:-1], "63 observations from 5 spots or more"),
        ([0.0, 1.0, 2.0, 3.0] * 16, "its most similar observations from 4 spots"),
        ([None] * NEIGHBOURS, "its most similar observations from 0 spots"),
    ],
)
def test_a_thin_map_says_what_it_has_too_little_of(spots: list[float | None], says: str) -> None:
    assert thinness([CROP], [_row(spots)]) == says


def test_observations_of_several_crops_count_once() -> None:
    rows = [_row([0.0, 1.0]), _row([1.0, 2.0], first=1)]
    assert thinness([CROP, CROP], rows) == "3 observations from 3 spots"


def test_classes_tell_nothing_of_it() -> None:
    assert thinness([QuestionCrop(None, class_name="chair")], [_row([0.0])]) is None
    assert thinness([], []) is None


@pytest.mark.parametrize("method", ["joint", "plain"])
def test_answers_say_so(method: str) -> None:
    answer = rank([CROP], MapCandidates((_row([0.0]),), {}), method=method)  # type: ignore[arg-type]
    assert answer.document()["thin"] == "1 observation from 1 spot"
    full = rank([CROP], MapCandidates((_row(FULL),), {}), method=method)  # type: ignore[arg-type]
    assert full.document()["thin"] is None
