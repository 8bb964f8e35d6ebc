"""Camera model: a level pinhole; bearings, sizes and edges of boxes.

A box's centre gives a bearing, its height a relative depth: the height in pixels times the depth in
metres is the same for one thing from wherever it is seen (its *size*, in pixel metres). So do its
upper and its lower edge: the rise of the line of sight to an edge times the distance is the height
of that edge above the camera. A box that touches the picture's border is cut off there: such an
edge is not used, and the bearing counts less.

*Cues* are the evidence of boxes for the distance of a landmark: two quantities, each the mean over
the observations whose boxes the picture's border does not cut there:

size        logarithm of the box's height in metres, log(height at 1 m) + log(distance)
elevation   of the upper or lower edge above the camera: rise of the line of sight × distance

Both are computed from the estimated position, so they contain its error; each comes with its
gradient with respect to the position. A thing seen from one spot may be farther away than
estimated, but then it is larger, too, and looks the same from that spot.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import StatedCamera
from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import CameraConstants

from .constants import RankingModel

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
_MIN_HEIGHT_PX = 4.0
_EDGE_PX = 1.0
_UNKNOWN_HEIGHT_PX = 100.0
_STEEPEST = 10.0
_FARTHEST_PX = 1e6
"""The limit of coordinates, which keeps squares in the geometry finite."""


CameraValues: TypeAlias = tuple[float, float, float, float]
"""Horizontal field of view in degrees, width and height in pixels, and the angle at which the
camera is mounted, radians to the left."""


def camera_values(camera: CameraConstants | StatedCamera) -> CameraValues:
    """The values of a camera of the settings or of an envelope."""
    return camera.hfov_deg, camera.width_px, camera.height_px, camera.yaw_rad


def half_field_rad(camera: CameraConstants) -> float:
    """Half the horizontal field of view."""
    return math.radians(camera.hfov_deg) / 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Cameras:
    """The cameras that n boxes come from: arrays (n,), or (1,) where one took all pictures."""

    width_px: Floats
    height_px: Floats
    focal_px: Floats
    yaw_rad: Floats

    @classmethod
    def of(cls, cameras: Sequence[CameraValues]) -> "Cameras":
        """The cameras of boxes, one for each of them."""
        one = all(each == cameras[0] for each in cameras)
        values = np.array(cameras[:1] if one else cameras, np.float64).reshape(-1, 4)
        hfov_deg, width, height, yaw = values.T
        return cls(width, height, width / 2.0 / np.tan(np.radians(hfov_deg) / 2.0), yaw)

    def take(self, index: NDArray[np.intp]) -> "Cameras":
        """The cameras of the boxes at ``index``."""
        if len(self.width_px) == 1:
            return self
        each = self.width_px, self.height_px, self.focal_px, self.yaw_rad
        return Cameras(*(values.take(index) for values in each))


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


def views(cameras: Cameras, rows: Floats) -> Views:
    """The slopes and heights of boxes of `box_rows`."""
    x0, y0, x1, y1 = np.minimum(np.maximum(rows.T, -_FARTHEST_PX), _FARTHEST_PX)
    known = (x1 > x0) & (y1 > y0)
    slope = (cameras.width_px / 2.0 - (x0 + x1) / 2.0) / cameras.focal_px
    return Views(
        slope=np.where(known, slope, 0.0),
        height_px=np.where(known, np.maximum(y1 - y0, _MIN_HEIGHT_PX), _UNKNOWN_HEIGHT_PX),
        cut_x=(x0 <= _EDGE_PX) | (x1 >= cameras.width_px - _EDGE_PX),
        cut_y=(y0 <= _EDGE_PX) | (y1 >= cameras.height_px - _EDGE_PX),
        known=known,
    )


UPPER, LOWER = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class SightLines:
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

    def take(self, index: NDArray[np.intp] | slice) -> "SightLines":
        """The lines of sight at ``index``."""
        return SightLines(
            self.bearing[index],
            self.log_height[index],
            self.rise[:, index],
            self.whole[:, index],
            self.cut[index],
            self.known[index],
        )


def sights(cameras: Cameras, rows: Floats) -> SightLines:
    """The lines of sight of boxes of `box_rows`; parts farther outside the picture than the picture
    is large are cut off."""
    most = np.stack((cameras.width_px, cameras.height_px) * 2)
    x0, y0, x1, y1 = np.minimum(np.maximum(rows.T, -most), 2.0 * most)
    known = (x1 > x0) & (y1 > y0)
    tangent = (cameras.width_px / 2.0 - (x0 + x1) / 2.0) / cameras.focal_px
    per_px = 1.0 / (cameras.focal_px * np.sqrt(1.0 + tangent * tangent))
    rise = (cameras.height_px / 2.0 - np.stack((y0, y1))) * per_px
    inside = np.stack((y0 > _EDGE_PX, y1 < cameras.height_px - _EDGE_PX))
    return SightLines(
        bearing=np.where(known, np.arctan(tangent) + cameras.yaw_rad, 0.0),
        log_height=np.log(np.maximum(y1 - y0, _MIN_HEIGHT_PX) * per_px),
        rise=rise,
        whole=inside & known & (np.abs(rise) < _STEEPEST),
        cut=(x0 <= _EDGE_PX) | (x1 >= cameras.width_px - _EDGE_PX),
        known=known,
    )


Indices = NDArray[np.intp]

_NEAREST_M: Final = 0.3
_PRIOR_EDGES: Final = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Cue:
    """A quantity of n landmarks, its gradient with respect to their position, and its variance at a
    given position, infinite where nothing is known."""

    mean: Floats
    by_x: Floats
    by_y: Floats
    variance: Floats

    def part(self, rows: slice) -> "Cue":
        """The cue of some of the landmarks."""
        return Cue(self.mean[rows], self.by_x[rows], self.by_y[rows], self.variance[rows])


def cues(
    boxes: SightLines,
    poses: Floats,
    sight: Floats,
    at: Floats,
    starts: Indices,
    model: RankingModel,
) -> tuple[Cue, tuple[Cue, Cue]]:
    """The cues of landmarks: size, and the elevations of the upper and the lower edge. Of each
    observation, ``at`` (m, 2) is the position of its landmark and ``sight`` (m,) its direction in
    the map."""
    ux, uy = np.cos(sight), np.sin(sight)
    ahead = (at[:, 0] - poses[:, 0]) * ux + (at[:, 1] - poses[:, 1]) * uy
    ahead = np.maximum(ahead, _NEAREST_M)
    per = 1.0 / ahead
    tall = boxes.tall.astype(np.float64)
    size, _, count = _mean_cue(boxes.log_height + np.log(ahead), ux * per, uy * per, tall, starts)
    size = Cue(
        size.mean, size.by_x, size.by_y, np.where(count > 0.0, model.size_spread**2, math.inf)
    )
    edges = []
    for edge in (UPPER, LOWER):
        rise, whole = boxes.rise[edge], boxes.whole[edge].astype(np.float64)
        cue, scatter, count = _mean_cue(rise * ahead, rise * ux, rise * uy, whole, starts)
        part = model.edge_part * cue.mean
        prior = _PRIOR_EDGES * (model.edge_m**2 + part * part)
        variance = np.where(count > 0.0, (scatter + prior) / (count + _PRIOR_EDGES), math.inf)
        edges.append(Cue(cue.mean, cue.by_x, cue.by_y, variance))
    return size, (edges[0], edges[1])


def _mean_cue(
    value: Floats, by_x: Floats, by_y: Floats, weight: Floats, starts: Indices
) -> tuple[Cue, Floats, Floats]:
    """Weighted means over each landmark's observations, the sum of squared deviations, and the
    weight; the variance is left 0."""
    count = np.add.reduceat(weight, starts)
    safe = np.maximum(count, 1e-9)
    rows = np.stack((value, value * value, by_x, by_y)) * weight
    mean, square, x, y = np.add.reduceat(rows, starts, axis=1) / safe
    scatter = np.maximum(square - mean * mean, 0.0) * count
    return Cue(mean, x, y, np.zeros_like(mean)), scatter, count


def with_class_sizes(
    size: Cue, classes: Sequence[str], evidence: EvidenceConstants, model: RankingModel
) -> Cue:
    """``size``, with the known size of the class for landmarks that have no box with a height."""
    mean, variance = size.mean.copy(), size.variance.copy()
    for index in np.flatnonzero(~np.isfinite(variance)).tolist():
        height = evidence.sizes_m.get(classes[index])
        if height is not None:
            mean[index] = math.log(height)
            variance[index] = evidence.size_spread**2 + model.size_spread**2
    return Cue(mean, size.by_x, size.by_y, variance)
