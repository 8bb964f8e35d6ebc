"""A trajectory laid over the keyframes of a run: the corrected pose of each.

By keyframe id a keyframe takes the pose with its id. By stamp it takes the pose at its timestamp:
x and y linearly between the two poses around it, yaw the shorter way round. Nothing is
extrapolated: a keyframe before the first or after the last pose takes that one if it is within
``slack_s`` of it, and otherwise stays as it is.
"""

import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from eventsrc.envelope.commands import CorrectedPose
from eventsrc.envelope.model import KeyframeId
from eventsrc.envelope.trajectory import Trajectory, TrajectoryPose

DEFAULT_SLACK_S = 0.05


class RunKeyframe(NamedTuple):
    """A keyframe of the run, ``timestamp`` in seconds."""

    keyframe_id: KeyframeId
    timestamp: float


class Laid(NamedTuple):
    """``poses`` in the order of the keyframes; ``left`` are keyframes that stay as they are;
    ``unknown`` are poses of keyframes that the run does not have; ``widest_s`` is the longest time
    between two poses that was interpolated over."""

    poses: tuple[CorrectedPose, ...]
    left: tuple[KeyframeId, ...]
    unknown: tuple[TrajectoryPose, ...]
    widest_s: float


def lay(
    trajectory: Trajectory, keyframes: Iterable[RunKeyframe], slack_s: float = DEFAULT_SLACK_S
) -> Laid:
    """The corrected poses of the keyframes of a run."""
    if trajectory.by == "keyframe":
        return _by_keyframe(trajectory, list(keyframes))
    stamps = [pose.key for pose in trajectory.poses]
    poses, left, widest = [], [], 0.0
    for keyframe_id, timestamp in keyframes:
        found = _pose_at(trajectory.poses, stamps, timestamp, slack_s)
        if found is None:
            left.append(keyframe_id)
            continue
        (x, y, yaw), width = found
        widest = max(widest, width)
        poses.append(CorrectedPose(keyframe_id=keyframe_id, x=x, y=y, yaw=yaw))
    return Laid(tuple(poses), tuple(left), (), widest)


def _by_keyframe(trajectory: Trajectory, keyframes: Sequence[RunKeyframe]) -> Laid:
    given = {KeyframeId(int(pose.key)): pose for pose in trajectory.poses}
    poses = [
        CorrectedPose(keyframe_id=k.keyframe_id, x=pose.x, y=pose.y, yaw=pose.yaw)
        for k in keyframes
        if (pose := given.get(k.keyframe_id)) is not None
    ]
    left = tuple(k.keyframe_id for k in keyframes if k.keyframe_id not in given)
    there = {k.keyframe_id for k in keyframes}
    unknown = tuple(pose for id_, pose in given.items() if id_ not in there)
    return Laid(tuple(poses), left, unknown, 0.0)


def _pose_at(
    poses: Sequence[TrajectoryPose], stamps: Sequence[float], at: float, slack_s: float
) -> tuple[tuple[float, float, float], float] | None:
    """The pose at a time, and the time between the poses around it; None outside."""
    index = bisect_left(stamps, at)
    if index < len(poses) and stamps[index] == at:
        return _values(poses[index]), 0.0
    if index == 0:
        return (_values(poses[0]), 0.0) if stamps[0] - at <= slack_s else None
    if index == len(poses):
        return (_values(poses[-1]), 0.0) if at - stamps[-1] <= slack_s else None
    before, after = poses[index - 1], poses[index]
    width = after.key - before.key
    part = (at - before.key) / width
    turn = math.remainder(after.yaw - before.yaw, math.tau)
    pose = (
        before.x + part * (after.x - before.x),
        before.y + part * (after.y - before.y),
        math.remainder(before.yaw + part * turn, math.tau),
    )
    return pose, width


def _values(pose: TrajectoryPose) -> tuple[float, float, float]:
    return pose.x, pose.y, pose.yaw
