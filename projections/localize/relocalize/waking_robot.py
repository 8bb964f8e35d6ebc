"""A robot that does not know where it is: its last keyframes as one question, and the rule by which
an answer is sure enough to tell the robot.

The question has all keyframes since the robot began to look that show something, the last
`MOST_KEYFRAMES` of them, with their most confident crops. Poses of keyframes are those of odometry:
only the movement between them counts.

An answer is sure if its confidence and its `known` are high enough and nearly all of the
posterior's weight is near its pose and its heading. In that the crops count as `_INDEPENDENT` at
most: a robot that turns sees the same things again, and what the map says wrongly of where these
stand is the same in all its views. The numbers were chosen on the developing half of generated
worlds (`scripts/bench_truth --lost`).
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from eventsrc.envelope.ingest import Accepted
from projections.fold.exact import quantise, to_float32
from projections.fold.settings import CameraSettings
from projections.fold.sights import camera_of

from .certainty import probability
from .question import MAX_CROPS, Movement, Question, QuestionCrop, QuestionView
from .ranking import Answer

_CROPS: Final = 4
"""The most crops of a keyframe."""
MOST_KEYFRAMES: Final = 20
"""Keyframes that are remembered: odometry errs with the way."""
_LEAST_VIEWS: Final = 2
_LEAST_CONFIDENCE: Final = 0.6
_LEAST_KNOWN: Final = 0.8
"""Without the allowance for another day: a wrong initial pose costs more than none."""
_LEAST_WEIGHT: Final = 0.93
_INDEPENDENT: Final = 5
_NEAR_M: Final = 0.8
_NEAR_RAD: Final = math.radians(20.0)
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

    def see(self, keyframe: Accepted) -> Question | None:
        """Take in a keyframe; the question to ask now, None if it shows nothing."""
        if self._seen and keyframe.envelope.run_id != self._seen[-1].envelope.run_id:
            self._seen.clear()
        if keyframe.envelope.map_x is None or not _most_confident(keyframe):
            return None
        self._seen = [*self._seen[1 - MOST_KEYFRAMES :], keyframe]
        views, before = [], self._seen[0]
        for each, chosen in zip(self._seen, _chosen(self._seen), strict=True):
            crops = tuple(crop_of(each, index) for index in chosen)
            views.append(QuestionView(*moved_between(pose_of(before), pose_of(each)), crops))
            before = each
        stated = keyframe.envelope.camera
        camera = None if stated is None else camera_of(stated, CameraSettings())
        return Question(tuple(views), camera)

    def judge(self, answer: Answer) -> SurePose | None:
        """The pose at the last keyframe, if the answer to its question is sure."""
        if len(self._seen) < _LEAST_VIEWS:
            return None
        return _sure_pose(answer, crops=sum(map(len, _chosen(self._seen))))


def _sure_pose(answer: Answer, crops: int) -> SurePose | None:
    pose, hypotheses = answer.pose, answer.hypotheses
    if pose is None or pose.yaw is None or hypotheses is None or answer.thin is not None:
        return None
    if answer.confidence < _LEAST_CONFIDENCE:
        return None
    known = answer.known if answer.looks is None else probability(answer.looks.logit)
    if known < _LEAST_KNOWN:
        return None
    off = hypotheses.poses - (pose.x, pose.y, pose.yaw)
    off[:, 2] = np.remainder(off[:, 2] + math.pi, math.tau) - math.pi
    here = np.array([floor == pose.floor for floor in hypotheses.floors])
    near = (np.hypot(*off[:, :2].T) < _NEAR_M) & (np.abs(off[:, 2]) < _NEAR_RAD) & here
    weights = hypotheses.weights ** min(1.0, _INDEPENDENT / crops)
    weights /= weights.sum()
    if weights[near].sum() < _LEAST_WEIGHT:
        return None
    covariance = (off[near] * weights[near, None]).T @ off[near] / weights[near].sum()
    covariance += np.diag((_LEAST_SIGMA_M**2, _LEAST_SIGMA_M**2, _LEAST_SIGMA_RAD**2))
    return SurePose(pose.x, pose.y, pose.yaw, tuple(covariance.ravel().tolist()), pose.floor)


def _chosen(keyframes: Sequence[Accepted]) -> list[list[int]]:
    """The detections of each keyframe to ask with, `MAX_CROPS` in all: the most confident one of
    each, then the second of those that have one, and so on, of the latest keyframes first."""
    usable = [_most_confident(each) for each in keyframes]
    rounds = [(rank, -at) for at, each in enumerate(usable) for rank in range(len(each))]
    counts = Counter(-at for _, at in sorted(rounds)[:MAX_CROPS])
    return [each[: counts[at]] for at, each in enumerate(usable)]


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
