"""Questions: the object crops a lost robot sees, in one picture or in several.

The crops of a view come from one picture: their boxes give the direction of each. Where views are
of several poses, the robot's pose at each is known given that at the last one.

The movement between two views is known but for a small error that grows with it: 2 cm and a
twentieth of the way, and 0.01 rad and a twentieth of the turn. The errors of all movements up to
the last view add up, and a turn's error moves what lies behind it sideways.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from projections.fold.settings import CameraConstants

from .camera import Floats

MAX_CROPS: Final = 32
"""More crops than this are refused: each one costs a search."""
MAX_VIEWS: Final = 8
"""More views than this are refused."""
_MAX_DESCRIBED: Final = 80

Vector = NDArray[np.float32]
Box = tuple[float, float, float, float]
Movement = tuple[float, float, float]
"""Metres ahead and to the left and radians to the left, in the robot's frame before it."""
STILL: Final[Movement] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class QuestionCrop:
    """One crop: a unit vector, float32 of shape (dim,), and what else is known about it.

    ``vector`` is None when only the class is known; ``is_text`` is whether it is the embedding of a
    text. ``bbox`` is x_min, y_min, x_max, y_max in pixels of the whole picture, None when unknown.
    """

    vector: Vector | None
    bbox: Box | None = None
    class_name: str | None = None
    det_id: str | None = None
    model: str | None = None
    is_text: bool = False

    def by_class(self) -> "QuestionCrop":
        """The crop without its embedding, if it has a class."""
        return self if self.class_name is None else replace(self, vector=None)

    def called(self, names: Mapping[str, str]) -> "QuestionCrop":
        """The crop with the map's name of its class, where a detector has its own."""
        name = names.get(self.class_name or "")
        return self if name is None else replace(self, class_name=name)

    @property
    def sort_key(self) -> tuple[bytes, Box, str, str]:
        """A key that sorts crops in the same order however they were sent."""
        look = b"" if self.vector is None else self.vector.tobytes()
        box = self.bbox or (0.0, 0.0, 0.0, 0.0)
        return look, box, self.det_id or "", self.class_name or ""


@dataclass(frozen=True, slots=True, eq=False)
class QuestionView:
    """The crops of one picture, and the robot's movement since the view before: metres ahead and to
    the left, and radians to the left, in its frame at that view; all 0 in the first view."""

    dx: float
    dy: float
    dyaw: float
    crops: tuple[QuestionCrop, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """Successive views of a robot; the answer is its pose at the last one.

    ``camera`` is None where the question does not state it.
    """

    views: tuple[QuestionView, ...]
    camera: CameraConstants | None = None

    @property
    def crops(self) -> tuple[QuestionCrop, ...]:
        """The crops of all views, in order."""
        return tuple(crop for view in self.views for crop in view.crops)

    def by_class(self) -> "Question":
        """The question without embeddings of crops that have a class."""
        views = (replace(v, crops=tuple(c.by_class() for c in v.crops)) for v in self.views)
        return replace(self, views=tuple(views))

    @classmethod
    def of(cls, crops: Sequence[QuestionCrop]) -> "Question":
        """The question of one picture."""
        return cls((QuestionView(0.0, 0.0, 0.0, tuple(crops)),))


def describe_value(value: Any) -> str:
    """A value of a question for an error message: escaped, and at most 80 characters."""
    if isinstance(value, list | dict):
        return f"a {'list' if isinstance(value, list) else 'JSON object'}"
    text = repr(value[:_MAX_DESCRIBED] if isinstance(value, str) else value)
    return text if len(text) <= _MAX_DESCRIBED else f"{text[:_MAX_DESCRIBED]}…"


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
    """Poses (h, 3) at every view from those at the last one; ``movements`` as in `QuestionView`."""
    found = [poses]
    for dx, dy, dyaw in reversed(movements[1:]):
        x, y, yaw = found[-1].T
        yaw = yaw - dyaw
        cos, sin = np.cos(yaw), np.sin(yaw)
        found.append(np.column_stack((x - (cos * dx - sin * dy), y - (sin * dx + cos * dy), yaw)))
    return found[::-1]
