"""Views from several poses: the robot's pose at each, given its pose at the last one.

The movement between two views is known but for a small error that grows with it: 2 cm and a
twentieth of the way, and 0.01 rad and a twentieth of the turn. The errors of all movements up to
the last view add up, and a turn's error moves what lies behind it sideways.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .camera import Floats

Movement = tuple[float, float, float]
"""Metres ahead and to the left in the robot's frame at the view before, and radians to the left."""

_STEP_M, _STEP_PART = 0.02, 0.05
_TURN_RAD, _TURN_PART = 0.01, 0.05


@dataclass(frozen=True, slots=True)
class Behind:
    """The error of the pose at a view, given the pose at the last one, and its distance from
    that."""

    m2: float
    yaw2: float
    away_m: float
    turn: float


def behind_last(movements: Sequence[Movement]) -> list[Behind]:
    """For each view the movement and its error between it and the last one."""
    m2 = yaw2 = turn = 0.0
    x = y = 0.0
    found = [Behind(0.0, 0.0, 0.0, 0.0)]
    for dx, dy, dyaw in reversed(movements[1:]):
        length = math.hypot(dx, dy)
        yaw2 += _TURN_RAD**2 + (_TURN_PART * dyaw) ** 2
        m2 += _STEP_M**2 + (_STEP_PART * length) ** 2 + yaw2 * length * length
        turn += dyaw
        cos, sin = math.cos(-turn), math.sin(-turn)
        x, y = x - (cos * dx - sin * dy), y - (sin * dx + cos * dy)
        found.append(Behind(m2, yaw2, math.hypot(x, y), turn))
    return found[::-1]


def poses_at_views(poses: Floats, movements: Sequence[Movement]) -> list[Floats]:
    """Poses (h, 3) at every view from those at the last one; ``movements`` as in `View`."""
    found = [poses]
    for dx, dy, dyaw in reversed(movements[1:]):
        x, y, yaw = found[-1].T
        yaw = yaw - dyaw
        cos, sin = np.cos(yaw), np.sin(yaw)
        found.append(np.column_stack((x - (cos * dx - sin * dy), y - (sin * dx + cos * dy), yaw)))
    return found[::-1]
