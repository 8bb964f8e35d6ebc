"""Plane geometry in metres: rectangles, wall segments, lines of sight."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Rect:
    """A rectangle with sides along x and y; x0 <= x1 and y0 <= y1."""

    x0: float
    y0: float
    x1: float
    y1: float

    @classmethod
    def around(cls, x: float, y: float, width: float, height: float) -> "Rect":
        """The rectangle of this size with its centre at (x, y)."""
        return cls(x - width / 2, y - height / 2, x + width / 2, y + height / 2)

    @property
    def centre(self) -> Point:
        """The coordinates of the centre."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    @property
    def width(self) -> float:
        """The extent along x."""
        return self.x1 - self.x0

    @property
    def height(self) -> float:
        """The extent along y."""
        return self.y1 - self.y0

    def grown(self, by: float) -> "Rect":
        """The same rectangle with ``by`` added on each side."""
        return Rect(self.x0 - by, self.y0 - by, self.x1 + by, self.y1 + by)

    def contains(self, x: float, y: float) -> bool:
        """Whether (x, y) is inside or on the edge."""
        return self.x0 <= x <= self.x1 and self.y0 <= y <= self.y1

    def encloses(self, other: "Rect") -> bool:
        """Whether ``other`` lies wholly inside."""
        return self.contains(other.x0, other.y0) and self.contains(other.x1, other.y1)

    def overlaps(self, other: "Rect") -> bool:
        """Whether the two share more than an edge."""
        return (
            self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1
        )


@dataclass(frozen=True, slots=True)
class Segment:
    """A straight piece of wall from (x0, y0) to (x1, y1)."""

    x0: float
    y0: float
    x1: float
    y1: float


class Walls:
    """Wall segments as arrays, for vectorised queries."""

    def __init__(self, segments: Sequence[Segment]) -> None:
        ends = np.array([(s.x0, s.y0, s.x1, s.y1) for s in segments], dtype=np.float64)
        self._start = ends[:, 0:2]
        self._along = ends[:, 2:4] - ends[:, 0:2]

    def block(self, a: Point, b: Point) -> bool:
        """Whether any wall crosses or touches the line from ``a`` to ``b``."""
        ray = np.array([b[0] - a[0], b[1] - a[1]])
        to_start = self._start - np.array(a)
        across = _cross(ray, self._along)
        parallel = across == 0.0
        safe = np.where(parallel, 1.0, across)
        on_ray = _cross(to_start, self._along) / safe
        on_wall = _cross(to_start, ray) / safe
        hit = (on_ray >= 0) & (on_ray <= 1) & (on_wall >= 0) & (on_wall <= 1) & ~parallel
        return bool(hit.any())

    def clearance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance of each of ``points``, shape (n, 2), to the nearest wall, shape (n,)."""
        nearest = np.full(len(points), math.inf)
        for start, along in zip(self._start, self._along, strict=True):
            length_2 = max(float(along[0] * along[0] + along[1] * along[1]), 1e-12)
            offset = points - start
            t = (offset[:, 0] * along[0] + offset[:, 1] * along[1]) / length_2
            t = np.clip(t, 0.0, 1.0)
            dx = offset[:, 0] - t * along[0]
            dy = offset[:, 1] - t * along[1]
            nearest = np.minimum(nearest, np.sqrt(dx * dx + dy * dy))
        return nearest


def rect_clearance(rect: Rect, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each of ``points``, shape (n, 2), to ``rect``; 0 inside. Shape (n,)."""
    dx = np.maximum(np.maximum(rect.x0 - points[:, 0], points[:, 0] - rect.x1), 0.0)
    dy = np.maximum(np.maximum(rect.y0 - points[:, 1], points[:, 1] - rect.y1), 0.0)
    distance: NDArray[np.float64] = np.sqrt(dx * dx + dy * dy)
    return distance


def wrap(angle: float) -> float:
    """``angle`` in radians, brought into (-π, π]."""
    wrapped = math.fmod(angle, 2 * math.pi)
    if wrapped > math.pi:
        return wrapped - 2 * math.pi
    return wrapped + 2 * math.pi if wrapped <= -math.pi else wrapped


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    product: NDArray[np.float64] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product
