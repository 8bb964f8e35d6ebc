"""The transform between two runs' frames: found whatever the frames, refused between buildings, its
matching the best one; and jumps within a run."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.model import KeyframeId
from projections.fold.evidence import EvidenceConstants
from projections.fold.looks import LookRatios
from projections.fold.settings import CameraSettings, Settings
from projections.localize.align import matching
from projections.localize.align.alignment import align, decision_text
from projections.localize.align.framed_things import FramedThings, things_of_map
from projections.localize.align.jumps import LargeStep, find_jumps
from projections.localize.align.matching import Comparison, Tie, _best_matching, moved
from tests.support.folds import Folded
from tests.support.logs import simulated

EVIDENCE = Settings(fusion="evidence", camera=CameraSettings(hfov_deg=69.4))
Frame = tuple[float, float, float]
HERE: Frame = (0.0, 0.0, 0.0)


def in_frame(envelope: dict[str, Any], frame: Frame) -> dict[str, Any]:
    """The envelope with its pose in another map frame."""
    ((x, y),) = moved(np.array([[envelope["map_x"], envelope["map_y"]]]), frame).tolist()
    yaw = math.remainder(envelope["map_yaw"] + frame[2], math.tau)
    return envelope | {"map_x": x, "map_y": y, "map_yaw": yaw}


@cache
def things(run: str, frame: Frame = HERE, seed: int = 7) -> FramedThings:
    documents = [in_frame(envelope, frame) for envelope in simulated(seed, run).envelopes]
    found = things_of_map(Folded.start(EVIDENCE).extend(documents).view)
    assert found is not None
    return found


def error_m(things_: FramedThings, found: Frame, frame: Frame) -> float:
    """How far the transform that was found puts the poses from where they were before ``frame``."""
    here = things_.poses[:, :2]
    turned = moved(here - frame[:2], (0.0, 0.0, -frame[2]))
    return float(np.sqrt(((moved(here, found) - turned) ** 2).sum(1).mean()))


@pytest.mark.parametrize(
    "frame", [(-300.0, 80.0, -3.1), pytest.param((0.0, 0.5, 0.0), marks=pytest.mark.slow)]
)
def test_another_run_of_a_house_is_found_in_any_frame(frame: Frame) -> None:
    found = align(things("a"), things("b", frame))
    assert found is not None
    assert found.verdict == "sure"
    assert not found.is_one_frame
    assert error_m(things("b", frame), found.transform, frame) < min(0.5, 3.0 * found.se_m)
    assert len({one for one, _, _ in found.pairs}) == len(found.pairs) >= 12
    assert f"{len(found.pairs)} common things" in decision_text(found)


def test_two_runs_of_one_frame_are_left_as_they_are() -> None:
    found = align(things("a"), things("b"))
    assert found is not None
    assert found.is_one_frame
    assert "already in one frame" in decision_text(found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5, 11])
def test_another_house_is_not_surely_this_one(seed: int) -> None:
    found = align(things("a"), things("a", seed=seed))
    assert found is None or found.verdict != "sure"
    assert "but not surely" in decision_text(found) or "cannot tell: " in decision_text(found)


def test_of_floors_that_look_alike_none_is_taken() -> None:
    """A building with the same furniture on two floors, which a map has side by side."""
    floor, aside = things("a"), np.array([60.0, 0.0])
    both = replace(
        floor,
        object_ids=(*floor.object_ids, *(f"{each}_above" for each in floor.object_ids)),
        classes=np.tile(floor.classes, 2),
        xy=np.concatenate((floor.xy, floor.xy + aside)),
        covariance=np.tile(floor.covariance, (2, 1, 1)),
        looks=np.tile(floor.looks, (2, 1)),
        sides=np.tile(floor.sides, 2),
        owners=np.concatenate((floor.owners, floor.owners + len(floor.xy))),
        seen=np.tile(floor.seen, 2),
        looked_at=np.concatenate((floor.looked_at, floor.looked_at + aside)),
    )
    found = align(both, things("b"))
    assert found is not None
    assert found.verdict == "unknown"
    assert found.is_ambiguous
    assert "but another transform has" in decision_text(found)


def test_a_tie_adds_to_what_keeps_it_and_rules_out_the_rest() -> None:
    frame = (12.0, -7.0, 2.1)
    there, here = things("b", frame), things("b")
    free = align(things("a"), there)
    tie = Tie(there.poses[9], here.poses[9], 0.3, 0.2)
    tied = align(things("a"), there, tie)
    assert free is not None
    assert tied is not None
    assert tied.transform == pytest.approx(free.transform, abs=0.05)
    assert tied.score > free.score + 3.0
    assert tied.se_m < free.se_m
    elsewhere = tie._replace(to=here.poses[9] + (4.0, 4.0, 1.0))
    wrong = align(things("a"), there, elsewhere)
    assert wrong is None or wrong.verdict == "unknown"


def test_nothing_in_common_is_said() -> None:
    assert decision_text(None) == "cannot tell: 0 common things; 12 are usually enough"


def test_a_map_without_things_has_none_to_compare() -> None:
    nothing = [envelope | {"detections": []} for envelope in simulated().envelopes[:9]]
    assert things_of_map(Folded.start(EVIDENCE).extend(nothing).view) is None


def test_looks_of_different_spaces_are_refused() -> None:
    documents = []
    for envelope in simulated().envelopes[:60]:
        seen = [d | {"embedding_model": "another"} for d in envelope["detections"]]
        documents.append(envelope | {"detections": seen})
    other = things_of_map(Folded.start(EVIDENCE).extend(documents).view)
    assert other is not None
    with pytest.raises(MisuseError, match=r"different spaces, .* and another \(512\)"):
        align(things("a"), other)


def test_ratios_of_pairs_are_those_of_their_looks() -> None:
    """Against a recount look by look; the likely pairs are those of the largest ratios."""
    first, second = things("a"), things("b")
    both, table = Comparison(first, second), LookRatios(EvidenceConstants())
    labels, counts = np.unique([*first.classes, *second.classes], return_counts=True)
    shares = dict(zip(labels, counts / counts.sum(), strict=True))
    different = (first.different + second.different) / 2

    def ratio(i: int, j: int, angle: float) -> float:
        agree = first.classes[i] == second.classes[j]
        rows, columns = np.flatnonzero(first.owners == i), np.flatnonzero(second.owners == j)
        likeness = (first.looks[rows] @ second.looks[columns].T - different) / (1 - different)
        sides = np.cos(first.sides[rows][:, None] - second.sides[columns] - angle)
        one, labels_agree = np.ones((1, 1), bool), np.full((1, 1), agree)
        found = table.ratios(np.maximum(likeness, 0.0), sides, one, labels_agree).clip(-6.0, 6.0)
        by_label = math.log(0.85 / shares[first.classes[i]]) if agree else math.log(0.15)
        return float(found.mean() * min(math.sqrt(found.size), 3.0) + by_label / 2)

    count = len(first.xy), len(second.xy)
    for number in range(0, count[0] * count[1], 7):
        i, j = divmod(number, count[1])
        found = both.ratios_at(0.7, np.array([i]), np.array([j]))
        assert found[0] == pytest.approx(ratio(i, j, 0.7), abs=0.02)  # looks are in float32
    firsts, seconds, by_turn = both.likely_pairs(of_each=3, most=500)
    best = np.array(
        [
            [max(ratio(i, j, math.tau * t / 16) for t in range(16)) for j in range(count[1])]
            for i in range(0, count[0], 5)
        ]
    )
    chosen = set(zip(firsts.tolist(), seconds.tolist(), strict=True))
    for row, i in zip(best, range(0, count[0], 5), strict=True):
        j = int(row.argmax())
        assert row[j] <= 0.1 or (i, j) in chosen
    assert (np.diff(by_turn.max(0)) <= 0).all()


def test_of_a_very_large_map_fewer_looks_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching, "_MOST_COMPARED", 2 * len(things("a").xy))
    found = align(things("a"), things("b"))
    assert found is not None
    assert found.verdict == "sure"
    assert found.is_one_frame


def test_a_score_is_the_sum_over_pairs_of_its_parts() -> None:
    """Against a recount pair by pair, without a tree and without arrays of pairs."""
    first, second = things("a"), things("b")
    both, transform = Comparison(first, second), (0.1, -0.05, 0.02)
    found = both.matching(transform)
    there = moved(second.xy, transform)
    cos, sin = math.cos(transform[2]), math.sin(transform[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    assert len(found) >= 12
    for i, j, value in zip(found.firsts, found.seconds, found.values, strict=True):
        spread = first.covariance[i] + turn @ second.covariance[j] @ turn.T + 0.04 * np.eye(2)
        apart = first.xy[i] - there[j]
        chi2 = float(apart @ np.linalg.inv(spread) @ apart)
        by_chance = 2 * math.pi * math.sqrt(np.linalg.det(spread)) * first.density
        by_looks = float(both.ratios_at(transform[2], np.array([i]), np.array([j]))[0])
        assert value == pytest.approx(by_looks - chi2 / 2 - math.log(by_chance))


SHIFT: Frame = (6.0, 0.0, 0.2)
"""Every point of the house moves by 3 m or more."""


def jumped(run: str, start: int, back: int | None = None) -> list[dict[str, Any]]:
    """A run whose frame is another from one keyframe on, and right again from a later one on."""
    seen = simulated(7, run).envelopes
    return [
        in_frame(each, SHIFT) if start <= n < (len(seen) if back is None else back) else each
        for n, each in enumerate(seen)
    ]


def steps(documents: list[dict[str, Any]]) -> list[LargeStep]:
    """The large steps of a run that is alone in its log."""

    def part(is_in: Callable[[KeyframeId], bool]) -> FramedThings | None:
        some = [each for each in documents if is_in(each["keyframe_id"])]
        return things_of_map(Folded.start(EVIDENCE).extend(some).view)

    return list(
        find_jumps(
            Folded.start(EVIDENCE).extend(documents).view.keyframes,
            lambda stretch: part(stretch.has),
            lambda stretch: part(lambda each: not stretch.has(each)),
        )
    )


def test_a_run_that_drives_on_has_no_large_step() -> None:
    assert steps(simulated().envelopes) == []


@pytest.mark.parametrize("count", [20, 32, 80])
def test_a_large_step_of_a_short_run_is_seen(count: int) -> None:
    documents = jumped("a", count // 2)[:count]
    assert [each.stretch.first for each in steps(documents)] == [
        documents[count // 2]["keyframe_id"]
    ]


def test_a_robot_that_was_parked_before_and_after_has_one_large_step() -> None:
    parked = [
        {**each, "map_x": 6.0 * (n >= 20), "map_y": 0.0, "map_yaw": 0.0}
        for n, each in enumerate(simulated().envelopes[:40])
    ]
    assert [each.step_m for each in steps(parked)] == [6.0]


@pytest.mark.slow
def test_a_stretch_too_short_to_be_compared_is_not_left_out() -> None:
    documents = jumped("a", 200, 205)
    found = steps(documents)
    assert [each.stretch.first for each in found] == [
        documents[number]["keyframe_id"] for number in (200, 205)
    ]
    assert found[0].found is None


@pytest.mark.parametrize("back", [None, pytest.param(320, marks=pytest.mark.slow)])
def test_the_tail_behind_a_jump_is_brought_back(back: int | None) -> None:
    documents = jumped("a", 200, back)
    first, *others = steps(documents)
    assert first.is_jump
    assert first.stretch.first == documents[200]["keyframe_id"]
    assert first.stretch.last == (None if back is None else documents[back - 1]["keyframe_id"])
    assert first.found is not None
    here = np.array([(e["map_x"], e["map_y"]) for e in documents[200:back]])
    there = np.array([(e["map_x"], e["map_y"]) for e in simulated().envelopes[200:back]])
    assert np.hypot(*(moved(here, first.found.transform) - there).T).max() < 0.5
    assert not any(each.is_jump for each in others)  # the run is back in its frame


@pytest.mark.slow
def test_a_robot_that_was_carried_did_not_jump() -> None:
    """Its frame is right before and after; only the way between is missing."""
    documents = [*simulated().envelopes[:150], *simulated().envelopes[250:]]
    assert not any(each.is_jump for each in steps(documents))


PAIRS = st.dictionaries(
    st.tuples(st.integers(0, 4), st.integers(0, 4)), st.integers(1, 1000), max_size=9
)


@given(PAIRS)
@settings(max_examples=150)
def test_the_matching_is_the_best_of_all(values: dict[tuple[int, int], int]) -> None:
    pairs = sorted(values)
    firsts, seconds = (np.array([pair[side] for pair in pairs], np.intp) for side in (0, 1))
    found = _best_matching(HERE, firsts, seconds, np.array([values[pair] for pair in pairs], float))
    chosen = found.pairs()
    assert {i for i, _ in chosen} == set(found.firsts.tolist())
    assert len({j for _, j in chosen}) == len(found) == len(chosen)
    assert found.score == sum(values[pair] for pair in chosen) == _most(values, pairs)


def _most(values: dict[tuple[int, int], int], pairs: list[tuple[int, int]]) -> int:
    """The largest sum of any subset in which no thing is twice."""
    return max(
        sum(values[pair] for pair in some)
        for size in range(min(5, len(pairs)) + 1)
        for some in combinations(pairs, size)
        if len({i for i, _ in some}) == len({j for _, j in some}) == size
    )
