"""How far re-localisation's probabilities are off on a map: lines through its own questions."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.settings import LocalizerConstants
from projections.localize.calibrate.localiser import (
    CONFIDENCE_USUAL,
    KNOWN_USUAL,
    Line,
    OwnScores,
    correction,
    fit_line,
    logit,
)
from projections.localize.evaluate.own_questions import OwnAnswer, own_scores
from projections.localize.relocalize import Answer
from projections.localize.relocalize.certainty import probability
from projections.surfaces.cli.calibrate import localiser_document, localiser_text

MANY = 100_000
"""Observations of a map that is not thin."""


def _answer(
    known: bool, said: float, sure: float, error: float | None = 0.5, crops: int = 1
) -> OwnAnswer:
    return OwnAnswer(crops, not known, known, Answer((), None, sure, said), error, 2.0, said)


def _own(logits: Sequence[float], line: Line, seed: int = 5) -> list[OwnAnswer]:
    """Answers that say σ(z), and are right with the probability of the line at z."""
    rng = np.random.default_rng(seed)
    right = [rng.random() < probability(line.scale * z + line.shift) for z in logits]
    return [_answer(r, probability(z), probability(z)) for z, r in zip(logits, right, strict=True)]


def _spread_logits(count: int) -> list[float]:
    return np.random.default_rng(1).uniform(-5.0, 5.0, count).tolist()


def test_without_questions_nothing_is_corrected() -> None:
    assert correction([], 0) == LocalizerConstants()
    assert fit_line([], [], Line(0.7, 0.2), 1.0) == pytest.approx(Line(0.7, 0.2))


def test_a_map_like_those_of_the_weights_is_hardly_corrected() -> None:
    constants = correction(_own(_spread_logits(3000), KNOWN_USUAL), MANY)
    assert constants.known_scale == pytest.approx(1.0, abs=0.1)
    assert constants.known_shift == pytest.approx(0.0, abs=0.2)
    assert constants.known_count == constants.confidence_count == 3000


@pytest.mark.parametrize("off", [Line(1.0, 2.0), Line(1.6, -1.5)])
def test_the_correction_makes_the_probabilities_those_of_the_other_maps(off: Line) -> None:
    """A map that says z where others would say scale · z + shift."""
    usual = KNOWN_USUAL
    seen = Line(usual.scale * off.scale, usual.scale * off.shift + usual.shift)
    constants = correction(_own(_spread_logits(4000), seen), MANY)
    assert constants.known_scale == pytest.approx(off.scale, rel=0.12)
    assert constants.known_shift == pytest.approx(off.shift, abs=0.25)


def test_few_questions_leave_it_near_what_is_usual() -> None:
    """All are known, whatever is said: the more of them, the further the shift goes."""
    shifts = [
        correction([_answer(True, 0.5, 0.5)] * count, MANY).known_shift
        for count in (0, 1, 8, 64, 512)
    ]
    assert shifts[0] == 0.0
    assert shifts == sorted(set(shifts))
    assert shifts[1] < 0.3
    assert shifts[4] > 1.5
    sure = correction([_answer(True, 0.5, 0.5)] * 64, MANY).confidence_shift
    assert 0.0 < sure < 0.5 * shifts[3]


def test_a_thin_map_is_corrected_less_by_degrees() -> None:
    answers = [_answer(True, 0.5, 0.5)] * 64
    shifts = [correction(answers, count).known_shift for count in (0, 10, 65, 200, MANY)]
    assert 0.0 < shifts[0] < 0.1
    assert shifts == sorted(set(shifts))


@pytest.mark.seconds
def test_nonsense_is_bounded() -> None:
    wrong = [_answer(z < 0, probability(z), 0.5, None) for z in _spread_logits(14_000)]
    constants = correction(wrong, MANY)
    assert constants.known_scale == 0.25
    assert -4.0 <= constants.known_shift <= 4.0
    assert constants.confidence_shift == -4.0


@given(st.lists(st.tuples(st.floats(-6, 6), st.booleans()), max_size=40))
def test_the_line_is_the_most_probable_one(pairs: list[tuple[float, bool]]) -> None:
    """Oracle: steps in all directions away from it are less probable."""
    usual = Line(0.8, 0.3)

    def cost(scale: float, shift: float) -> float:
        likelihood = sum(
            math.log1p(math.exp(-(scale * z + shift) * (1 if y else -1))) for z, y in pairs
        )
        return likelihood + 1.5 * (shift - usual.shift) ** 2 + 6.0 * (scale - usual.scale) ** 2

    found = fit_line([z for z, _ in pairs], [y for _, y in pairs], usual, 3.0)
    best = cost(*found)
    for angle in range(8):
        off = 0.05 * math.cos(angle * math.pi / 4), 0.05 * math.sin(angle * math.pi / 4)
        assert cost(found.scale + off[0], found.shift + off[1]) > best


def test_last_bits_of_probabilities_are_not_in_the_constants() -> None:
    """Neither those of each probability, nor the order of the answers."""
    said = _own(_spread_logits(400), Line(1.3, -0.4))
    expected = correction(said, MANY)
    assert expected != LocalizerConstants(known_count=400, confidence_count=400)
    for towards in (0.0, 1.0):
        moved = [
            replace(
                each,
                answer=replace(
                    each.answer,
                    known=math.nextafter(each.answer.known, towards),
                    confidence=math.nextafter(each.answer.confidence, towards),
                ),
            )
            for each in said
        ]
        assert correction(moved, MANY) == expected
        assert correction(moved[::-1], MANY) == expected


@given(st.lists(st.tuples(st.floats(-6, 6), st.booleans()), max_size=40))
def test_the_line_does_not_depend_on_the_order(pairs: list[tuple[float, bool]]) -> None:
    first, second = (
        fit_line([z for z, _ in order], [y for _, y in order], Line(0.8, 0.3), 3.0)
        for order in (pairs, pairs[::-1])
    )
    assert first == second


@given(st.floats(-20.0, 20.0))
def test_the_logit_is_that_of_the_probability(z: float) -> None:
    assert logit(probability(z)) == pytest.approx(z, abs=1e-6)


def test_certain_answers_have_finite_logits() -> None:
    assert logit(1.0) == pytest.approx(-logit(0.0))
    assert 20.0 < logit(1.0) < 21.0


def test_the_scores_are_of_the_corrected_probabilities() -> None:
    answers = (_answer(True, 0.4, 0.9), _answer(True, 0.9, 0.9, 3.0), _answer(False, 0.1, 0.2))
    own = OwnScores(answers, LocalizerConstants(known_shift=1.0, confidence_shift=-1.0))
    assert own.known(answers[0]) == pytest.approx(probability(logit(0.4) + 1.0))
    assert own.confidence(answers[0]) == pytest.approx(probability(logit(0.9) - 1.0))
    plain = own_scores(answers)
    assert (plain["known"], plain["questions"]) == (2, 3)
    assert plain["known_called_unknown"] == 0.5
    assert plain["taken_out_called_known"] == 0.0
    assert plain["within_1_5_m"] == 0.5
    assert plain["pose_error_m"] == {"p50": 1.75, "p90": pytest.approx(2.75)}
    assert plain["plain"]["pose_error_m"]["p50"] == 2.0
    assert plain["auroc"] == plain["best_cosine"]["auroc"] == 1.0
    document = localiser_document(own)
    assert document["questions"]["1"]["known_called_unknown"] == 0.0
    assert document["questions"]["3"]["questions"] == 0
    assert document["constants"]["localizer.known_shift"] == 1.0
    assert "localizer.text_shift" not in document["constants"]
    assert document["questions"]["1"]["ece"] == round(
        own_scores(answers, own.known, own.confidence)["ece"], 6
    )


def test_the_text_says_how_often_what_was_said_was_right() -> None:
    answers = [_answer(True, 0.9, 0.9) for _ in range(30)]
    answers += [_answer(False, 0.1, 0.1) for _ in range(30)]
    answers += [_answer(False, 0.9, 0.1), _answer(True, 0.9, 0.9, 2.0)]
    text = localiser_text(OwnScores(tuple(answers), LocalizerConstants()))
    head, one, bins, known, sure = text.splitlines()
    assert head.split()[0] == "re-localisation"
    assert one.split()[:4] == ["1", "crop", "31", "31"]
    assert bins.endswith("said 0.75 to 1")
    assert known.split() == ["known", *["0.00", "of", "30", "-", "-", "0.97", "of", "32"]]
    assert sure.split() == ["confidence", *["0.00", "of", "31", "-", "-", "0.97", "of", "31"]]


def test_few_questions_are_called_too_few() -> None:
    nothing = OwnScores((), LocalizerConstants())
    assert localiser_text(nothing) == "re-localisation: no keyframe to ask from\n"
    one = OwnScores((_answer(True, 0.9, 0.9), _answer(False, 0.1, 0.1)), LocalizerConstants())
    assert "1 question about what was seen at another time: too few for" in localiser_text(one)


def test_the_usual_lines_rise() -> None:
    assert min(KNOWN_USUAL.scale, CONFIDENCE_USUAL.scale) > 0.3
