"""Whether the map has the things shown: a probability that does not depend on the embedding."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.model import RunId
from projections.fold.deltas import ObservationOrdinal
from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import LocalizerConstants
from projections.localize.relocalize import MapConstants, Match, QuestionCrop, rank
from projections.localize.relocalize.candidates import MapCandidates
from projections.localize.relocalize.certainty import (
    Looks,
    QuestionSession,
    known_features,
    known_probability,
    looks_of,
)
from projections.localize.relocalize.constants import ANY_DAY, USUAL_DAY, SessionPrior

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
    matches = [_matches(row) for row in rows]
    return known_probability(looks_of([crop] * len(rows), matches, constants), matches)


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
    constants = MapConstants(session=USUAL_DAY)
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
    assert _known([[0.0]], constants, NAMED) == 0.5
    assert _known([[]], constants, NAMED) == 0.0
    assert _known([], constants) == 0.0


def test_unknown_follows_from_known() -> None:
    for cosine, unknown in ((0.95, False), (0.55, True)):
        answer = rank([CROP], MapCandidates((_matches([cosine] * 4),), {}))
        assert answer.unknown is unknown
        document = answer.document()
        assert (document["known"], document["unknown"]) == (answer.known, unknown)
        assert (answer.known < 0.5) is unknown


def _after(logits: list[float], logit: float) -> tuple[float, float]:
    """`known` and its spread, of a question after others."""
    session = QuestionSession()
    for each in logits:
        session.add(Looks(each, ANY_DAY))
    return session.known(Looks(logit, ANY_DAY))


@given(st.floats(-30.0, 20.0))
def test_the_first_question_of_a_session_is_answered_as_alone(logit: float) -> None:
    known, spread = _after([], logit)
    assert known == pytest.approx(Looks(logit, ANY_DAY).known)
    assert 0.0 <= spread <= 0.5


@given(st.lists(st.floats(-30.0, 20.0), max_size=8), st.floats(-30.0, 20.0))
def test_a_session_gives_probabilities_that_rise_with_likeness(
    before: list[float], logit: float
) -> None:
    known, spread = _after(before, logit)
    assert 0.0 <= known <= _after(before, logit + 1.0)[0] + 1e-9 <= 1.0 + 1e-9
    assert 0.0 <= spread <= 1.0


def test_a_day_that_costs_much_is_learnt_from_its_questions() -> None:
    """All are less alike than usual; or nothing is in the map, but a look-alike."""
    doubtful = -1.8
    alone, unsure = _after([], doubtful)
    known, spread = _after([0.0, -1.0, 0.5, -0.5, 1.0] * 2, doubtful)
    assert alone < 0.5 < known
    assert spread < unsure
    assert _after([-7.0, -8.0, -6.5, -9.0, -7.5] * 2, doubtful)[0] < alone


def test_the_order_of_a_sessions_questions_does_not_matter() -> None:
    before = [-3.0, 1.0, 0.2, -7.0]
    assert _after(before, 0.0) == pytest.approx(_after(before[::-1], 0.0))


def test_what_another_day_costs_is_less_uncertain_once_it_was_read() -> None:
    usual = EvidenceConstants().session_shift
    little, much = (
        SessionPrior.of(EvidenceConstants(session_shift=usual + more)) for more in (0.01, 0.1)
    )
    assert SessionPrior.of(EvidenceConstants()) == ANY_DAY
    assert little.mean < ANY_DAY.mean < much.mean
    assert little.spread == much.spread < ANY_DAY.spread
