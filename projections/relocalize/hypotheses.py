"""Poses the robot may be at, before they are weighed.

Three sources. Poses from which a landmark's observations were made. With a box, the circle around a
landmark at the crop's range, facing so that the box lies where it does. With two boxes, the one
pose that puts two landmarks where two crops show them (a rigid fit of two points, resection).
"""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from .camera import Floats
from .landmarks import Landmark
from .sighting import Sighting

_RING: Final = np.arange(24) * (2.0 * np.pi / 24)
_POSES_OF_LANDMARK: Final = 12
_MISFIT_M: Final = 1.0
"""Two landmarks whose distance differs by more from the crops' are not the pair seen."""


def propose(sightings: Sequence[Sighting]) -> Floats:
    """Poses of shape (h, 3): x, y in metres, yaw in radians; at least one per sighting."""
    parts: list[Floats] = []
    for sighting in sightings:
        for landmark in sighting.landmarks:
            parts.append(sighting.poses[landmark.members[:_POSES_OF_LANDMARK]])
            if sighting.bearing is not None:
                parts.append(_circle(sighting, landmark))
    boxed = [s for s in sightings if s.bearing is not None]
    resected = [pose for one, other in combinations(boxed, 2) for pose in _resect(one, other)]
    parts.append(np.array(resected, dtype=np.float64).reshape(-1, 3))
    return np.concatenate(parts)


def _circle(sighting: Sighting, landmark: Landmark) -> Floats:
    bearing = sighting.bearing or 0.0
    reach = sighting.depth / math.cos(bearing)
    return np.stack(
        (
            landmark.x + reach * np.cos(_RING),
            landmark.y + reach * np.sin(_RING),
            _RING + (np.pi - bearing),
        ),
        axis=1,
    )


def _resect(one: Sighting, other: Sighting) -> Iterator[tuple[float, float, float]]:
    (ax, ay), (bx, by) = one.in_robot_frame, other.in_robot_frame
    seen, seen_yaw = math.hypot(bx - ax, by - ay), math.atan2(by - ay, bx - ax)
    for a in one.landmarks:
        for b in other.landmarks:
            dx, dy = b.x - a.x, b.y - a.y
            if a is b or abs(math.hypot(dx, dy) - seen) > _MISFIT_M:
                continue
            yaw = math.atan2(dy, dx) - seen_yaw
            cos, sin = math.cos(yaw), math.sin(yaw)
            mx, my = (ax + bx) / 2, (ay + by) / 2
            yield (
                (a.x + b.x) / 2 - (cos * mx - sin * my),
                (a.y + b.y) / 2 - (sin * mx + cos * my),
                yaw,
            )


_STEPS: Final = np.array(
    [(x, y, yaw) for x in (-0.2, 0.0, 0.2) for y in (-0.2, 0.0, 0.2) for yaw in (-0.07, 0.0, 0.07)]
)


def neighbours(poses: Floats) -> Floats:
    """Each pose and 26 around it: 0.2 m and 4° to every side."""
    around: Floats = (poses[:, None] + _STEPS[None]).reshape(-1, 3)
    return around
