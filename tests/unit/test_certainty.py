"""Whether the map has the things shown: a probability that does not depend on the embedding."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.model import RunId
from projections.fold.deltas import ObservationOrdinal
from projections.fold.settings import LocalizerConstants
from projections.localize.relocalize import MapConstants, Match, QuestionCrop, rank
from projections.localize.relocalize.candidates import MapCandidates
from projections.localize.relocalize.certainty import known_features, known_probability

CROP = QuestionCrop(np.ones(1, dtype=np.float32))
NAMED = QuestionCrop(None, class_name="chair")
TEXT = replace(CROP, is_text=True)

likenesses = st.lists(st.floats(-0.5, 1.0), min_size=1, max_size=6).map(
    lambda row: sorted(row, reverse=True)
)
questions = st.lists(likenesses, min_size=1, max_size=5)


def _matches(cosines: list[float]) -> tuple[Match, ...]:
    return tuple(
        Match(ObservationOrdinal(n), f"d{n}", RunId("r"), cosine, None, None, "chair")
        for n, cosine in enumerate(cosines)
    )


def _known(rows: list[list[float]], constants: MapConstants, crop: QuestionCrop = CROP) -> float:
    return known_probability([crop] * len(rows), [_matches(row) for row in rows], constants)


@given(questions, st.floats(-0.2, 0.9))
def test_another_embedding_space_gives_the_same(rows: list[list[float]], zero: float) -> None:
    """One whose different things have another cosine, and the same likenesses relative to it."""
    scaled = [[zero + each * (1.0 - zero) for each in row] for row in rows]
    found = _known(scaled, MapConstants(different=zero))
    assert found == pytest.approx(_known(rows, MapConstants(different=0.0)), abs=1e-6)
    assert 0.0 < found < 1.0


@given(questions, st.randoms())
def test_the_order_of_crops_does_not_matter(rows: list[list[float]], random: object) -> None:
    shuffled = list(rows)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    assert _known(rows, MapConstants()) == _known(shuffled, MapConstants())


@given(st.lists(st.floats(0.0, 0.9), min_size=1, max_size=4), st.floats(0.02, 0.1))
def test_known_rises_with_likeness(crops: list[float], more: float) -> None:
    flat = MapConstants(different=0.0)
    assert _known([[c + more] * 4 for c in crops], flat) > _known([[c] * 4 for c in crops], flat)


def test_the_same_thing_is_known_and_different_ones_are_not() -> None:
    constants = MapConstants(different=0.5)
    assert _known([[0.88, 0.87, 0.86, 0.86]], constants) > 0.8
    assert _known([[0.6, 0.6, 0.59, 0.58]], constants) < 0.1
    assert _known([[0.5], [0.5], [0.5]], constants) < 0.02


def test_a_maps_correction_scales_and_shifts_the_logit() -> None:
    rows = [[0.81, 0.8], [0.7]]
    constants = MapConstants()
    p = _known(rows, constants)
    localizer = LocalizerConstants(known_scale=0.5, known_shift=-1.0, known_count=9)
    corrected = _known(rows, replace(constants, localizer=localizer))
    assert np.log(corrected / (1 - corrected)) == pytest.approx(0.5 * np.log(p / (1 - p)) - 1.0)


def test_a_text_is_shifted_to_where_pictures_are() -> None:
    localizer = LocalizerConstants(text_shift=0.4)
    constants = MapConstants(localizer=localizer)
    assert _known([[0.3]], constants, TEXT) == pytest.approx(_known([[0.7]], constants))


def test_crops_without_a_look_or_matches_are_left_out() -> None:
    constants = MapConstants()
    rows = [_matches([0.9, 0.9]), _matches([0.9]), ()]
    found = known_features([CROP, NAMED, CROP], rows, constants)
    assert found == known_features([CROP], rows[:1], constants)
    assert known_probability([NAMED], [_matches([0.0])], constants) == 0.5
    assert known_probability([NAMED], [()], constants) == 0.0
    assert known_probability([], [], constants) == 0.0


def test_unknown_follows_from_known() -> None:
    for cosine, unknown in ((0.95, False), (0.55, True)):
        answer = rank([CROP], MapCandidates((_matches([cosine] * 4),), {}))
        assert answer.unknown is unknown
        document = answer.document()
        assert (document["known"], document["unknown"]) == (answer.known, unknown)
        assert (answer.known < 0.5) is unknown
