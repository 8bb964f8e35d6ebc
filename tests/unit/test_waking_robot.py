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
from projections.localize.relocalize.question import MAX_VIEWS
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


def told(second: Answer) -> SurePose | None:
    """A robot that drives 1 m ahead and turns by 0.5, facing the map's y axis."""
    robot = WakingRobot()
    assert robot.see(keyframe(0, 0.0, 0.0)) is not None
    assert robot.judge(answer(5.0, 0.0)) is None  # nothing agrees with it yet
    assert robot.see(keyframe(1, 1.0, 0.5)) is not None
    assert robot.judge(answer(5.0, 0.0)) is None  # it did not move on
    assert robot.see(keyframe(2, 2.0, 0.5)) is not None
    return robot.judge(second)


def test_two_answers_that_agree_are_told() -> None:
    ahead = math.cos(0.5)  # of the turned robot, as odometry has it, in its own frame
    found = told(answer(5.0 + ahead, 0.0, 0.05))
    assert found is not None
    assert (found.x, found.yaw) == (5.0 + ahead, 0.0)
    covariance = np.reshape(found.covariance, (3, 3))
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
    assert covariance[0, 0] == pytest.approx(0.05**2 + 0.1**2)


@pytest.mark.parametrize(
    "less",
    [
        {"confidence": 0.7},
        {"known": 0.6},
        {"thin": "two spots"},
        {"pose": None},
        {"hypotheses": None},
        {"pose": PoseHypothesis(5.9, 2.0, None, 0.1)},
    ],
)
def test_an_answer_that_is_not_sure_is_not_told(less: dict[str, Any]) -> None:
    assert told(replace(answer(5.0 + math.cos(0.5), 0.0), **less)) is None


def test_answers_that_disagree_or_are_wide_are_not_told() -> None:
    at = 5.0 + math.cos(0.5)
    for wrong in (answer(at + 1.0, 0.0), answer(at, 0.3), answer(at, 0.0, 0.6)):
        assert told(wrong) is None


def test_an_answer_of_another_run_does_not_count() -> None:
    robot = WakingRobot()
    for number in (0, 1):
        assert robot.see(keyframe(number, 0.0, 0.0)) is not None
    assert robot.judge(answer(5.0, 0.0)) is None
    for number in (0, 1):
        assert robot.see(keyframe(number, 0.0, 0.0, run_id="other")) is not None
    assert robot.judge(answer(5.0, 0.0)) is None
    assert robot.judge(answer(5.0, 0.0)) is not None


def test_questions_have_the_latest_keyframe_and_views_spread_over_the_others() -> None:
    robot, question = WakingRobot(), None
    for number in range(MOST_KEYFRAMES + 5):
        question = robot.see(keyframe(number, 0.1 * number, 0.0, seen=9))
    assert question is not None
    assert len(question.views) == MAX_VIEWS
    assert sum(view.dx for view in question.views) == pytest.approx(0.1 * (MOST_KEYFRAMES - 1))
    assert question.views[-1].crops[0].det_id == f"r_kf{MOST_KEYFRAMES + 4}_d8"
    assert len(question.crops) == 32
    assert robot.see(keyframe(90, 0.0, 0.0, seen=0)) is None
    assert robot.see(keyframe(91, 0.0, 0.0, map_x=None, map_y=None, map_yaw=None)) is None
    again = robot.see(keyframe(0, 0.0, 0.0, run_id="other"))
    assert again is not None
    assert len(again.views) == 1
