"""The keyframe gate: which pictures become keyframes.

A picture is a keyframe when the robot has moved or turned far enough since the last keyframe with a
pose, or when the time since the last keyframe is up. A picture without a pose has only the time.
The first picture is one, and so is the first with a pose.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

MOVED_M = 0.5
TURNED_DEG = 15.0
AFTER_S = 5.0
_SLACK = 1e-6
"""Tolerance for rounding, metres and radians: ten steps of 5 cm count as half a metre."""


class Pose(NamedTuple):
    """The robot's pose in the map frame: metres, and radians to the left of the x axis."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True, slots=True)
class GateLimits:
    """The distance, turn and time after which a keyframe is due; None for ``after_s`` for no time
    limit."""

    moved_m: float = MOVED_M
    turned_rad: float = math.radians(TURNED_DEG)
    after_s: float | None = AFTER_S


class KeyframeGate:
    """Decides for each picture in turn whether it is a keyframe, from the last keyframe."""

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self._stamp_s: float | None = None
        self._pose: Pose | None = None

    def set_last(self, stamp_s: float, pose: Pose | None) -> None:
        """Set the last keyframe."""
        self._stamp_s = stamp_s
        self._pose = pose or self._pose

    def is_due(self, stamp_s: float, pose: Pose | None) -> bool:
        """Whether this picture should be a keyframe."""
        if self._stamp_s is None or (pose is not None and self._pose is None):
            return True
        after_s = self._limits.after_s
        if after_s is not None and abs(stamp_s - self._stamp_s) >= after_s:
            return True  # also for a stamp that jumps back, as of a recording that starts again
        if pose is None or self._pose is None:
            return False
        moved = math.hypot(pose.x - self._pose.x, pose.y - self._pose.y)
        turned = abs(math.remainder(pose.yaw - self._pose.yaw, math.tau))
        return moved >= self._limits.moved_m - _SLACK or turned >= self._limits.turned_rad - _SLACK
