"""The questions, scores and table of ``scripts/bench_truth --localise``."""

from types import SimpleNamespace

import pytest

from projections.fold.settings import CameraSettings
from projections.localize import relocalize
from projections.localize.evaluate.questions import ScoredQuestion, spread
from projections.localize.evaluate.trials import Trial
from projections.localize.relocalize import Answer, PoseHypothesis
from scripts.programs.bench.truth.localising import (
    LocaliseRow,
    Scores,
    localise,
    score,
    stranger_of,
)
from scripts.programs.bench.truth.localising_table import localise_table
from scripts.programs.bench.truth.worlds import make_case
from tests.programs.truth_cases import trial_generator

HALVES = SimpleNamespace(DEVELOP=["w1", "w2", "w3"], VALIDATE=["v1", "v2"])


def _question(keyframe: int) -> ScoredQuestion:
    return ScoredQuestion(("q", keyframe), relocalize.Question(()), 0.0, 0.0, 0.0, None, ())


def _trial(
    confidence: float,
    in_map: float,
    cosine: float,
    *,
    known: bool,
    error: float | None,
    plain: float,
) -> Trial:
    pose = None if error is None else PoseHypothesis(error, 0.0, None, 0.0)
    question = _question(1)
    answer = Answer((), pose, confidence, in_map)
    return Trial(
        question,
        answer,
        known,
        error,
        None,
        None,
        None,
        None,
        False,
        (),
        (),
        None,
        plain,
        9.0,
        cosine,
        0.0,
    )


def test_scores_are_those_computed_by_hand() -> None:
    found = score(
        [
            _trial(0.95, 0.65, 0.9, known=True, error=0.5, plain=1.0),
            _trial(0.15, 0.45, 0.6, known=True, error=2.5, plain=2.0),
            _trial(0.85, 0.55, 0.7, known=False, error=0.1, plain=9.0),
            _trial(0.05, 0.05, 0.5, known=False, error=None, plain=9.0),
        ]
    )
    assert (found.questions, found.known) == (4, 2)
    assert (found.p50_m, found.plain_p50_m, found.place_p50_m) == (1.5, 1.5, 9.0)
    assert (found.within, found.plain_within) == (0.5, 0.5)
    assert found.auroc == 0.75  # of the four pairs only 0.45 against 0.55 is in the wrong order
    assert found.cosine_auroc == 0.75
    assert (found.known_called_unknown, found.unknown_called_known) == (0.5, 0.5)
    assert found.confidence_ece == pytest.approx((0.05 + 0.15 + 0.85 + 0.05) / 4)
    assert found.known_ece == pytest.approx((0.35 + 0.55 + 0.55 + 0.05) / 4)
    # One answer a bin: |y - p| is 1 - p with probability p, and p with 1 - p.
    expected = sum(2 * p * (1 - p) for p in (0.95, 0.15, 0.85, 0.05)) / 4
    assert found.confidence_floor == pytest.approx(expected)


def test_scores_of_nothing_are_nothing() -> None:
    found = score([])
    assert found.p50_m is found.auroc is found.within is found.known_called_unknown is None
    assert found.known_ece == found.known_floor == 0.0


def _scores(p50: float, plain: float) -> Scores:
    return Scores(10, 5, p50, 3.0, plain, 4.0, 5.0, 0.5, 0.4, 0.9, 0.8, *([0.1] * 9), 2.0)


def test_the_worst_beside_the_plain_baseline_stands_last_below_the_means() -> None:
    rows = [
        LocaliseRow("rover one", "page", {"1 crop": _scores(1.0, 2.0)}, 90.0, CameraSettings()),
        LocaliseRow("rover two", "page", {"1 crop": _scores(0.9, 1.0)}, 90.0, CameraSettings()),
        LocaliseRow("scout one", "page", {"1 crop": _scores(3.0, 4.0)}, 90.0, CameraSettings()),
    ]
    assert rows[0].scores["1 crop"].against_plain == 0.5
    lines = localise_table(rows).splitlines()
    names = [line[:26].strip() for line in lines]
    assert names[1:4] == ["rover one", "rover two", "scout one"]
    assert names[4:] == ["rover", "scout", "mean", "worst rover two"]
    assert lines[4].split()[3] == "0.95"  # of 1.0 and 0.9
    assert lines[-1].split()[3:6] == ["10", "5", "0.90"]
    brief = localise_table(rows, lines=False).splitlines()
    assert [line[:26].strip() for line in brief[1:]] == [
        "rover",
        "scout",
        "mean",
        "worst rover two",
    ]


def test_estimated_fields_of_view_stand_beside_the_true_ones() -> None:
    scores = {"1 crop": _scores(1.0, 2.0)}
    found = CameraSettings(hfov_deg=61.8, hfov_error_deg=0.4)
    rows = [
        LocaliseRow("tripod one", "evidence", scores, 62.0, found),
        LocaliseRow("rover one", "evidence", scores, 69.4, CameraSettings(hfov_deg=69.4)),
    ]
    head, *lines = localise_table(rows).split("\n\n")[-1].splitlines()
    assert head.split()[-4:] == ["true", "map", "error", "off"]
    assert [line.split() for line in lines] == [["tripod", "one", "62.0", "61.8", "0.4", "-0.2"]]


def test_as_many_questions_of_another_building_are_spread_evenly() -> None:
    of_ten = [
        ScoredQuestion(("q", n), relocalize.Question(()), 0.0, 0.0, 0.0, None, ())
        for n in range(10)
    ]
    assert [q.key[1] for q in spread(of_ten, 4)] == [0, 2, 5, 7]
    assert spread(of_ten, 20) == of_ten
    assert spread(of_ten, 0) == []


def test_the_other_building_is_one_of_the_same_half() -> None:
    others = [stranger_of(HALVES, "develop", world) for world in ("w1", "w2", "w3")]
    assert all(other != world for other, world in zip(others, ("w1", "w2", "w3"), strict=True))
    assert set(others) <= {"w1", "w2", "w3"}
    assert stranger_of(HALVES, "validate", "v1") == "v2"
    assert stranger_of(HALVES, "develop", "v1") == "w1"


@pytest.mark.slow
def test_a_building_is_mapped_by_both_rules_and_asked_with_known_and_unknown_things(tmp_path):
    generator = trial_generator()
    case, other = (
        make_case(generator, "rover", world, limit=60, cache=tmp_path)
        for world in ("tb3_house", "aws_house")
    )
    rows = localise(case, other, ("page", "evidence"), 6)
    assert [(row.name, row.map) for row in rows] == [
        ("rover tb3_house", "page"),
        ("rover tb3_house", "evidence"),
    ]
    for row in rows:
        assert list(row.scores) == ["1 crop", "3 crops", "1 view", "3 views", "5 views"]
        for scores in row.scores.values():
            assert 0 < scores.known < scores.questions
            assert scores.p50_m is not None
            assert scores.cosine_auroc is not None
    assert rows[0].document()["scores"]["1 crop"]["known"] == rows[0].scores["1 crop"].known
