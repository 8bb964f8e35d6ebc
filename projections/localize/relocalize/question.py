"""Questions: the object crops a lost robot sees, in one picture or in several.

The crops of a view come from one picture: their boxes give the direction of each.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .camera import Camera

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
class Crop:
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

    @property
    def sort_key(self) -> tuple[bytes, Box, str, str]:
        """A key that sorts crops in the same order however they were sent."""
        look = b"" if self.vector is None else self.vector.tobytes()
        box = self.bbox or (0.0, 0.0, 0.0, 0.0)
        return look, box, self.det_id or "", self.class_name or ""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The crops of one picture, and the robot's movement since the view before: metres ahead and to
    the left, and radians to the left, in its frame at that view; all 0 in the first view."""

    dx: float
    dy: float
    dyaw: float
    crops: tuple[Crop, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """Successive views of a robot; the answer is its pose at the last one.

    ``camera`` is None where the question does not state it.
    """

    views: tuple[View, ...]
    camera: Camera | None = None

    @property
    def crops(self) -> tuple[Crop, ...]:
        """The crops of all views, in order."""
        return tuple(crop for view in self.views for crop in view.crops)

    @classmethod
    def of(cls, crops: Sequence[Crop]) -> "Question":
        """The question of one picture."""
        return cls((View(0.0, 0.0, 0.0, tuple(crops)),))


def describe_value(value: Any) -> str:
    """A value of a question for an error message: escaped, and at most 80 characters."""
    if isinstance(value, list | dict):
        return f"a {'list' if isinstance(value, list) else 'JSON object'}"
    text = repr(value[:_MAX_DESCRIBED] if isinstance(value, str) else value)
    return text if len(text) <= _MAX_DESCRIBED else f"{text[:_MAX_DESCRIBED]}…"
