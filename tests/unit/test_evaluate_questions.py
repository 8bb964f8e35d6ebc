"""Questions of the evaluation: which crops, which views, and how the robot moved between them."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.ingest import Accepted, ingest_all
from projections.localize.evaluate.questions import VIEW_CROPS, make_questions, make_view_questions
from projections.localize.evaluate.truth import TrueKeyframe, Truth
from tests.support.envelopes import detection, envelope, payload


def _accepted(documents: list[dict[str, Any]]) -> list[Accepted]:
    return [each for each in ingest_all([*map(payload, documents)]) if isinstance(each, Accepted)]


def _drive(
    poses: list[tuple[float, float, float]], seen: list[int], run: str = "r"
) -> list[Accepted]:
    """Keyframes 0, 1, … of ``seen[i]`` detections with embeddings, and one without."""
    return _accepted(
        [
            envelope(
                n,
                x,
                y,
                map_yaw=yaw,
                run_id=run,
                detections=[*(detection("cup", np.eye(9)[i]) for i in range(count)), detection()],
            )
            for n, ((x, y, yaw), count) in enumerate(zip(poses, seen, strict=True))
        ]
    )


def _truth(keyframes: list[Accepted]) -> Truth:
    """Room k of keyframe k; detection i of it shows thing k-i."""
    found = {}
    for each in keyframes:
        run_id, n = each.envelope.run_id, each.envelope.keyframe_id
        things: list[str | None] = [f"{n}-{i}" for i in range(len(each.envelope.detections))]
        found[run_id, n] = TrueKeyframe(
            run_id=run_id, keyframe_id=n, room=f"room {n}", instances=things
        )
    return Truth(found)


def _still(count: int) -> list[tuple[float, float, float]]:
    return [(0.0, 0.0, 0.0)] * count


def test_one_question_of_every_keyframe_with_enough_embeddings() -> None:
    drive = _drive(_still(4), [2, 0, 1, 5])
    asked = make_questions(drive, _truth(drive), 2)
    assert [q.key for q in asked] == [("r", 0), ("r", 3)]
    for question in asked:
        assert len(question.crops) == len(question.instances) == 2
        assert len(question.asked.views) == 1
        named = [crop.det_id for crop in question.crops]
        kept = drive[question.key[1]]
        assert question.instances == tuple(
            f"{question.key[1]}-{kept.det_ids.index(name)}" for name in named
        )


def test_crops_of_a_smaller_question_are_among_those_of_a_larger_one() -> None:
    drive = _drive(_still(1), [7])
    crops = [
        {c.det_id for c in make_questions(drive, _truth(drive), n)[0].crops} for n in (1, 2, 3, 5)
    ]
    assert all(a < b for a, b in itertools.pairwise(crops))
    other = make_questions(drive, _truth(drive), 3, seed=1)[0]
    assert {c.det_id for c in other.crops} != crops[2]


def test_views_are_the_last_keyframes_with_embeddings_of_the_run() -> None:
    drive = _drive(_still(5), [1, 0, 2, 9, 1]) + _drive(_still(3), [1, 1, 1], "s")
    asked = make_view_questions(drive, _truth(drive), 3)
    assert [q.key for q in asked] == [("r", 3), ("r", 4), ("s", 2)]
    first, second, _ = asked
    assert [len(view.crops) for view in first.asked.views] == [1, 2, VIEW_CROPS]
    assert [len(view.crops) for view in second.asked.views] == [2, VIEW_CROPS, 1]
    assert len(first.instances) == 6
    assert first.room == "room 3"
    assert {i.split("-")[0] for i in first.instances if i} == {"0", "2", "3"}


def test_views_lie_not_too_far_back() -> None:
    drive = _drive(_still(9), [1, *([0] * 7), 1])
    assert [q.key[1] for q in make_view_questions(drive, _truth(drive), 2)] == []
    drive = _drive(_still(8), [1, *([0] * 6), 1])
    assert [q.key[1] for q in make_view_questions(drive, _truth(drive), 2)] == [7]


def test_without_truth_there_is_no_question() -> None:
    drive = _drive(_still(3), [1, 1, 1])
    truth = _truth(drive[:1] + drive[2:])
    assert [q.key[1] for q in make_questions(drive, truth, 1)] == [0, 2]
    assert [q.key[1] for q in make_view_questions(drive, truth, 2)] == [2]


poses = st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3.1, 3.1))


@given(st.lists(poses, min_size=1, max_size=5))
def test_the_moves_lead_from_the_first_pose_to_the_last(drive: list[tuple[float, float, float]]):
    """Oracle: complex numbers, each move turned into the map frame and added."""
    kept = _drive(drive, [1] * len(drive))
    (question,) = make_view_questions(kept, _truth(kept), len(kept))
    first, *moves = question.asked.views
    assert (first.dx, first.dy, first.dyaw) == (0.0, 0.0, 0.0)
    at, yaw = complex(*drive[0][:2]), drive[0][2]
    for view in moves:
        at += complex(view.dx, view.dy) * complex(math.cos(yaw), math.sin(yaw))
        yaw += view.dyaw
        assert abs(view.dyaw) <= math.pi
    assert at == pytest.approx(complex(question.x, question.y), abs=1e-9)
    assert math.cos(yaw - question.yaw) == pytest.approx(1.0)
    assert (question.x, question.y, question.yaw) == drive[-1]
