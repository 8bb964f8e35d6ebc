"""Camera model: a level pinhole; bearings, sizes and edges of boxes.

A box's centre gives a bearing, its height a relative depth: the height in pixels times the depth in
metres is the same for one thing from wherever it is seen (its *size*, in pixel metres). So do its
upper and its lower edge: the rise of the line of sight to an edge times the distance is the height
of that edge above the camera. A box that touches the picture's border is cut off there: such an
edge is not used, and the bearing counts less.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import MisuseError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
_MIN_HEIGHT_PX = 4.0
_EDGE_PX = 1.0
_UNKNOWN_HEIGHT_PX = 100.0
_STEEPEST = 10.0
_FARTHEST_PX = 1e6
"""The limit of coordinates, which keeps squares in the geometry finite."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Picture size in pixels, horizontal field of view in degrees, and the angle from the robot's
    heading to where the camera looks, radians to the left."""

    width_px: float = 640.0
    height_px: float = 400.0
    hfov_deg: float = 69.4
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (self.width_px > 0 and self.height_px > 0 and 1.0 <= self.hfov_deg <= 170.0):
            raise MisuseError(
                f"no camera has {self.width_px:g} × {self.height_px:g} pixels and"
                f" {self.hfov_deg:g}°; give positive sizes and a horizontal field of view of 1"
                " to 170 degrees"
            )

    @property
    def focal_px(self) -> float:
        """The focal length in pixels."""
        return self.width_px / 2.0 / math.tan(math.radians(self.hfov_deg) / 2.0)

    @property
    def half_field_rad(self) -> float:
        """Half the horizontal field of view."""
        return math.radians(self.hfov_deg) / 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Tangents of the bearings (``slope``, left positive) and heights in pixels of n boxes.

    ``cut_x`` and ``cut_y`` mark boxes that touch the picture's edge at a side, at top or bottom.
    ``known`` is False where there is no box.
    """

    slope: Floats
    height_px: Floats
    cut_x: Flags
    cut_y: Flags
    known: Flags


_Box = tuple[float, float, float, float]
_NO_BOX = (0.0, 0.0, 0.0, 0.0)


def box_rows(boxes: Sequence[_Box | None]) -> Floats:
    """Boxes as rows (n, 4): x_min, y_min, x_max, y_max in pixels; None becomes an empty box."""
    rows = [_NO_BOX if box is None else box for box in boxes]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def views(camera: Camera, rows: Floats) -> Views:
    """The slopes and heights of boxes of `box_rows`."""
    x0, y0, x1, y1 = np.minimum(np.maximum(rows.T, -_FARTHEST_PX), _FARTHEST_PX)
    known = (x1 > x0) & (y1 > y0)
    slope = (camera.width_px / 2.0 - (x0 + x1) / 2.0) / camera.focal_px
    return Views(
        slope=np.where(known, slope, 0.0),
        height_px=np.where(known, np.maximum(y1 - y0, _MIN_HEIGHT_PX), _UNKNOWN_HEIGHT_PX),
        cut_x=(x0 <= _EDGE_PX) | (x1 >= camera.width_px - _EDGE_PX),
        cut_y=(y0 <= _EDGE_PX) | (y1 >= camera.height_px - _EDGE_PX),
        known=known,
    )


UPPER, LOWER = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """Lines of sight to n boxes. Distances are along the ground.

    ``bearing`` is radians to the left of the robot's heading, 0 without a box; ``log_height`` the
    logarithm of the box's height at a distance of 1 m; ``rise`` (2, n) how steeply the lines to the
    upper and lower edge rise, and ``whole`` (2, n) which of these the picture's border does not
    cut. ``cut`` marks boxes that it cuts at a side, ``known`` is False where there is no box.
    """

    bearing: Floats
    log_height: Floats
    rise: Floats
    whole: Flags
    cut: Flags
    known: Flags

    @property
    def tall(self) -> Flags:
        """Which boxes have both edges, and so a height."""
        both: Flags = self.whole[UPPER] & self.whole[LOWER]
        return both

    def take(self, index: NDArray[np.intp] | slice) -> "Sights":
        """The lines of sight at ``index``."""
        return Sights(
            self.bearing[index],
            self.log_height[index],
            self.rise[:, index],
            self.whole[:, index],
            self.cut[index],
            self.known[index],
        )


def sights(camera: Camera, rows: Floats) -> Sights:
    """The lines of sight of boxes of `box_rows`; parts farther outside the picture than the picture
    is large are cut off."""
    most = np.array((camera.width_px, camera.height_px) * 2)[:, None]
    x0, y0, x1, y1 = np.minimum(np.maximum(rows.T, -most), 2.0 * most)
    known = (x1 > x0) & (y1 > y0)
    tangent = (camera.width_px / 2.0 - (x0 + x1) / 2.0) / camera.focal_px
    per_px = 1.0 / (camera.focal_px * np.sqrt(1.0 + tangent * tangent))
    rise = (camera.height_px / 2.0 - np.stack((y0, y1))) * per_px
    inside = np.stack((y0 > _EDGE_PX, y1 < camera.height_px - _EDGE_PX))
    return Sights(
        bearing=np.where(known, np.arctan(tangent) + camera.yaw_rad, 0.0),
        log_height=np.log(np.maximum(y1 - y0, _MIN_HEIGHT_PX) * per_px),
        rise=rise,
        whole=inside & known & (np.abs(rise) < _STEEPEST),
        cut=(x0 <= _EDGE_PX) | (x1 >= camera.width_px - _EDGE_PX),
        known=known,
    )
