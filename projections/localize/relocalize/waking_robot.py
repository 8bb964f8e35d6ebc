"""A robot that does not know where it is: its last keyframes as one question, and the rule by which
an answer is sure enough to tell the robot.

The question has up to `MAX_VIEWS` of the keyframes since the robot began to look, spread evenly,
the latest one among them, each with its most confident crops. Poses of keyframes are those of
odometry: only the movement between them counts.

An answer is sure if its confidence, its `known` and the posterior's weight near its pose are high
enough and that weight is close together, and if the answer before was so too and agrees with it,
moved on by odometry: a look-alike deceives from one direction, seldom from two. The numbers were
chosen on the developing half of generated worlds (`scripts/bench_truth --lost`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from eventsrc.envelope.ingest import Accepted
from projections.fold.exact import quantise, to_float32
from projections.fold.settings import CameraSettings
from projections.fold.sights import camera_of

from .question import MAX_CROPS, MAX_VIEWS, Movement, Question, QuestionCrop, QuestionView
from .ranking import Answer

_CROPS: Final = MAX_CROPS // MAX_VIEWS
MOST_KEYFRAMES: Final = 20
"""Keyframes that are remembered: odometry errs with the way."""
_LEAST_VIEWS: Final = 2
_LEAST_CONFIDENCE: Final = 0.8
_LEAST_KNOWN: Final = 0.7
_LEAST_MASS: Final = 0.8
_MOST_SIGMA_M: Final = 0.25
_MOST_SIGMA_RAD: Final = 0.08
_AGREE_M: Final = 0.5
_AGREE_RAD: Final = math.radians(10.0)
_NEAR_M: Final = 1.0
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 0.1, math.radians(3.0)
"""Least standard errors of the published pose: the spacing of the poses of the posterior."""


@dataclass(frozen=True, slots=True)
class SurePose:
    """Where the robot is: metres and radians in the map frame, with the covariance of x, y and yaw,
    nine numbers."""

    x: float
    y: float
    yaw: float
    covariance: tuple[float, ...]
    floor: str | None = None


@dataclass
class WakingRobot:
    """The keyframes of a robot since it began to look around."""

    _seen: list[Accepted] = field(default_factory=list)
    _before: SurePose | None = None
    _before_at: Movement | None = None

    def see(self, keyframe: Accepted) -> Question | None:
        """Take in a keyframe; the question to ask now, None if it shows nothing."""
        if self._seen and keyframe.envelope.run_id != self._seen[-1].envelope.run_id:
            self._seen.clear()
            self._before = None
        if keyframe.envelope.map_x is None or not _most_confident(keyframe):
            return None
        self._seen = [*self._seen[1 - MOST_KEYFRAMES :], keyframe]
        views, before = [], None
        for each in _spread(self._seen, MAX_VIEWS):
            crops = tuple(crop_of(each, index) for index in _most_confident(each))
            moved = moved_between(pose_of(before or each), pose_of(each))
            views.append(QuestionView(*moved, crops))
            before = each
        stated = keyframe.envelope.camera
        camera = None if stated is None else camera_of(stated, CameraSettings())
        return Question(tuple(views), camera)

    def judge(self, answer: Answer) -> SurePose | None:
        """The pose at the last keyframe, if the answer to its question is sure."""
        now = pose_of(self._seen[-1])
        found = _sure_enough(answer) if len(self._seen) >= _LEAST_VIEWS else None
        before, before_at = self._before, self._before_at
        self._before, self._before_at = found, now
        if found is None or before is None or before_at is None or before.floor != found.floor:
            return None
        dx, dy, dyaw = moved_between(before_at, now)
        cos, sin = math.cos(before.yaw), math.sin(before.yaw)
        expected = before.x + cos * dx - sin * dy, before.y + sin * dx + cos * dy
        turned = math.remainder(before.yaw + dyaw - found.yaw, math.tau)
        agree = math.dist(expected, (found.x, found.y)) <= _AGREE_M and abs(turned) <= _AGREE_RAD
        return found if agree else None


def _sure_enough(answer: Answer) -> SurePose | None:
    pose, hypotheses = answer.pose, answer.hypotheses
    if pose is None or pose.yaw is None or hypotheses is None or answer.thin is not None:
        return None
    if answer.confidence < _LEAST_CONFIDENCE or answer.known < _LEAST_KNOWN:
        return None
    dx, dy = hypotheses.poses[:, 0] - pose.x, hypotheses.poses[:, 1] - pose.y
    here = np.array([floor == pose.floor for floor in hypotheses.floors])
    near = (np.hypot(dx, dy) < _NEAR_M) & here
    weights = hypotheses.weights[near]
    if weights.sum() < _LEAST_MASS:
        return None
    turned = np.remainder(hypotheses.poses[near, 2] - pose.yaw + math.pi, math.tau) - math.pi
    off = np.column_stack((dx[near], dy[near], turned))
    covariance = (off * weights[:, None]).T @ off / weights.sum()
    sigma = np.sqrt(covariance.diagonal())
    if max(sigma[:2]) > _MOST_SIGMA_M or sigma[2] > _MOST_SIGMA_RAD:
        return None
    covariance += np.diag((_LEAST_SIGMA_M**2, _LEAST_SIGMA_M**2, _LEAST_SIGMA_RAD**2))
    return SurePose(pose.x, pose.y, pose.yaw, tuple(covariance.ravel().tolist()), pose.floor)


def _spread(keyframes: Sequence[Accepted], most: int) -> list[Accepted]:
    """At most so many of them, evenly, the last one included."""
    count = min(most, len(keyframes))
    last = len(keyframes) - 1
    picked = {last - round(i * last / max(1, count - 1)) for i in range(count)}
    return [keyframes[i] for i in sorted(picked)]


def _most_confident(keyframe: Accepted) -> list[int]:
    """The detections to ask with: those that have an embedding, else all."""
    detections = keyframe.envelope.detections
    looks = [i for i, vector in enumerate(keyframe.vectors) if vector is not None]
    usable = looks or range(len(detections))
    return sorted(usable, key=lambda i: -detections[i].confidence)[:_CROPS]


def pose_of(keyframe: Accepted) -> Movement:
    """The pose that a keyframe states."""
    envelope = keyframe.envelope
    return envelope.map_x or 0.0, envelope.map_y or 0.0, envelope.map_yaw or 0.0


def moved_between(before: Movement, after: Movement) -> Movement:
    """Metres ahead and to the left, and radians to the left, in the frame of the first pose."""
    dx, dy, yaw = after[0] - before[0], after[1] - before[1], before[2]
    turned = math.remainder(after[2] - yaw, math.tau)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return cos * dx + sin * dy, cos * dy - sin * dx, turned


def crop_of(keyframe: Accepted, index: int) -> QuestionCrop:
    """A detection of a keyframe as a crop."""
    detection, vector = keyframe.envelope.detections[index], keyframe.vectors[index]
    return QuestionCrop(
        None if vector is None else to_float32(quantise(vector)),
        detection.bbox,
        detection.class_name,
        keyframe.det_ids[index],
        detection.embedding_model,
    )
