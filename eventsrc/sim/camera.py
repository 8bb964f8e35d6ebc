"""What the robot sees: a pinhole camera looking straight ahead, 640 × 400 pixels, 69.4° wide.

A thing is seen when it is in range, most of its box is in the picture, the box is not tiny, and no
wall stands between the camera and its middle or one of its sides. Furniture hides nothing.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from .house import House, Thing
from .shapes import wrap
from .walk import TruePose

WIDTH_PX, HEIGHT_PX = 640, 400
HFOV_RAD = math.radians(69.4)
FOCAL_PX = WIDTH_PX / 2 / math.tan(HFOV_RAD / 2)
CAMERA_HEIGHT_M = 0.75
RANGE_M = (0.5, 5.0)
_MIN_SIDE_PX = 14.0
_MIN_SHOWN = 0.55
_NEAR_M = 0.15

Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Sighting:
    """A thing in view: its exact box in pixels, its distance, and which side of it shows.

    ``side_rad`` is the direction from the thing to the camera, from the thing's own front.
    """

    thing: Thing
    box: Box
    distance_m: float
    side_rad: float


def sightings(house: House, pose: TruePose) -> Iterator[Sighting]:
    """Everything the camera sees from ``pose``, in the house's order of things."""
    for thing in house.things:
        x, y = thing.centre
        distance = math.hypot(x - pose.x, y - pose.y)
        if not RANGE_M[0] <= distance <= RANGE_M[1]:
            continue
        box = _shown(_project(thing, pose))
        if box is not None and _in_sight(house, thing, pose):
            side = wrap(math.atan2(pose.y - y, pose.x - x) - thing.facing_rad)
            yield Sighting(thing, box, distance, side)


def _project(thing: Thing, pose: TruePose) -> Box | None:
    """The box around the thing's eight corners, None when one is beside or behind the camera."""
    rect, cos, sin = thing.footprint, math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    heights = (thing.model.base_m, thing.model.base_m + thing.model.height_m)
    us: list[float] = []
    vs: list[float] = []
    for x in (rect.x0, rect.x1):
        for y in (rect.y0, rect.y1):
            ahead = (x - pose.x) * cos + (y - pose.y) * sin
            left = -(x - pose.x) * sin + (y - pose.y) * cos
            if ahead < _NEAR_M:
                return None
            us.append(WIDTH_PX / 2 - FOCAL_PX * left / ahead)
            vs += (HEIGHT_PX / 2 - FOCAL_PX * (h - CAMERA_HEIGHT_M) / ahead for h in heights)
    return min(us), min(vs), max(us), max(vs)


def _shown(box: Box | None) -> Box | None:
    """The part of ``box`` in the picture, None when that is too little of it."""
    if box is None:
        return None
    x0, y0, x1, y1 = box
    cut = max(x0, 0.0), max(y0, 0.0), min(x1, float(WIDTH_PX)), min(y1, float(HEIGHT_PX))
    wide, high = cut[2] - cut[0], cut[3] - cut[1]
    if wide < _MIN_SIDE_PX or high < _MIN_SIDE_PX:
        return None
    return cut if wide * high >= _MIN_SHOWN * (x1 - x0) * (y1 - y0) else None


def _in_sight(house: House, thing: Thing, pose: TruePose) -> bool:
    x, y = thing.centre
    away = math.hypot(x - pose.x, y - pose.y)
    half = 0.4 * min(thing.model.width_m, thing.model.depth_m)
    across = (-(y - pose.y) / away * half, (x - pose.x) / away * half)
    targets = [(x, y), (x + across[0], y + across[1]), (x - across[0], y - across[1])]
    clear = [not house.walls.block((pose.x, pose.y), target) for target in targets]
    return sum(clear) >= 2
