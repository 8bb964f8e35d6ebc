"""When an answer is sure enough to tell a lost robot where it is."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from eventsrc.envelope.ingest import Accepted, ingest
from projections.localize.relocalize import Answer, PoseHypothesis
from projections.localize.relocalize.layout import Hypotheses
from projections.localize.relocalize.waking_robot import MOST_KEYFRAMES, SurePose, WakingRobot


def keyframe(number: int, x: float, yaw: float, seen: int = 1, **more: Any) -> Accepted:
    boxes = [
        {"class": "cup", "confidence": 0.5 + each / 100, "bbox": [0.0, 0.0, 9.0, 9.0]}
        for each in range(seen)
    ]
    pose = {"map_x": x, "map_y": 0.0, "map_yaw": yaw}
    head = {"run_id": "r", "keyframe_id": number, "timestamp": float(number)}
    made = ingest(json.dumps({**head, **pose, "detections": boxes, **more}).encode())
    assert isinstance(made, Accepted)
    return made


def answer(x: float, yaw: float, spread_m: float = 0.05, **more: Any) -> Answer:
    """Sure, with a posterior of two poses about one."""
    poses = np.array([[x - spread_m, 2.0, yaw], [x + spread_m, 2.0, yaw]])
    found = Hypotheses(poses, np.array([0.5, 0.5]), (None, None))
    sure = Answer((), PoseHypothesis(x, 2.0, yaw, spread_m), 0.95, 0.95, found)
    return replace(sure, **more)


def told(second: Answer, seen: int = 1) -> SurePose | None:
    """A robot that drives 1 m ahead, turns by 0.5 and sees so many things in each keyframe."""
    robot = WakingRobot()
    assert robot.see(keyframe(0, 0.0, 0.0, seen)) is not None
    assert robot.judge(answer(5.0, 0.0)) is None  # one view
    assert robot.see(keyframe(1, 1.0, 0.5, seen)) is not None
    return robot.judge(second)


def test_a_sure_answer_to_two_views_is_told() -> None:
    found = told(answer(5.0, 0.3, 0.05))
    assert found is not None
    assert (found.x, found.y, found.yaw) == (5.0, 2.0, 0.3)
    covariance = np.reshape(found.covariance, (3, 3))
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
    assert covariance[0, 0] == pytest.approx(0.05**2 + 0.1**2)


@pytest.mark.parametrize(
    "less",
    [
        {"confidence": 0.5},
        {"known": 0.7},
        {"thin": "two spots"},
        {"pose": None},
        {"hypotheses": None},
        {"pose": PoseHypothesis(5.9, 2.0, 0.0, 0.1)},
        {"pose": PoseHypothesis(5.0, 2.0, None, 0.1)},
        {"pose": PoseHypothesis(5.0, 2.0, 0.0, 0.1, "upstairs")},
    ],
)
def test_an_answer_that_is_not_sure_is_not_told(less: dict[str, Any]) -> None:
    assert told(replace(answer(5.0, 0.0), **less)) is None


@pytest.mark.parametrize(
    "other", [(5.0, 3.1, 0.0), (5.0, 2.0, 0.4), (5.0, 2.0, math.pi)], ids=["away", "askew", "back"]
)
def test_weight_elsewhere_counts_the_more_the_more_crops_there_are(
    other: tuple[float, float, float],
) -> None:
    poses = np.array([[5.0, 2.0, 0.0], other])
    found = Hypotheses(poses, np.array([0.96, 0.04]), (None, None))
    sure = answer(5.0, 0.0, hypotheses=found)
    for seen, is_told in ((1, True), (2, True), (4, False), (9, False)):
        assert (told(sure, seen) is not None) == is_told


def test_a_keyframe_of_another_run_does_not_count() -> None:
    robot = WakingRobot()
    assert robot.see(keyframe(0, 0.0, 0.0)) is not None
    for number, is_told in ((0, False), (1, True)):
        assert robot.see(keyframe(number, 0.0, 0.0, run_id="other")) is not None
        assert (robot.judge(answer(5.0, 0.0)) is not None) == is_told


def test_questions_have_all_keyframes_that_show_something_and_their_best_crops() -> None:
    robot, question = WakingRobot(), None
    for number in range(MOST_KEYFRAMES + 5):
        question = robot.see(keyframe(number, 0.1 * number, 0.0, seen=9))
    assert question is not None
    assert [len(view.crops) for view in question.views] == [1] * 8 + [2] * 12
    assert sum(view.dx for view in question.views) == pytest.approx(0.1 * (MOST_KEYFRAMES - 1))
    assert question.views[-1].crops[0].det_id == f"r_kf{MOST_KEYFRAMES + 4}_d8"
    assert len(question.crops) == 32
    assert robot.see(keyframe(90, 0.0, 0.0, seen=0)) is None
    assert robot.see(keyframe(91, 0.0, 0.0, map_x=None, map_y=None, map_yaw=None)) is None
    again = robot.see(keyframe(0, 0.0, 0.0, run_id="other"))
    assert again is not None
    assert len(again.views) == 1
