"""Sights: the evidence of one picture for the positions of the things in it, in the map frame.

A sight is a ray from the camera. Its bearing comes from the box's centre in a level pinhole camera,
f = width / 2 / tan(hfov / 2); a box that the picture's border cuts at a side has a larger bearing
error. The error of the pose is added, so at the distance a the variance across the ray is (bearing
error · a)² + (pose error)².

An envelope may state its own pose's covariance. Then the variance across the ray is that of the
position in the direction across it, and the bearing error is at least that of the heading.

The box's height and its centre's height above the horizon, where the border cuts it neither at top
nor at bottom, are evidence of the distance once boxes are compared (`spots`). A measured depth or
position of the detection gives the distance directly. A depth without a standard error has a
twentieth of itself, at least 0.05 m; a position without one has 0.1 m.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import MAX_DEPTH_M, Detection, DetId, Envelope, StatedCamera

from .deltas import Body, FusibleObservation, ObservationOrdinal, Pose
from .evidence import EvidenceConstants
from .exact import cos_sin, log, metres_to_um
from .settings import CameraConstants, CameraSettings

_CUT_PX = 2.0
_HALF_DEGREE = 0.008726646259971648
_LEAST_M = 0.05
_LEAST_ERROR_M = 0.001
_MOST_BEARING_RAD2 = 10.0
"""The variance of an unknown heading."""
_FAR_PX = 1e6
_LEAST_PX = 0.5
_STEEPEST = 10.0
"""The greatest slope of a line of sight, up or down, at which a box gives a height: 84°."""


@lru_cache(maxsize=64)
def half_field(hfov_deg: float) -> tuple[float, float]:
    """Cosine and sine of half the field of view."""
    return cos_sin(hfov_deg * _HALF_DEGREE)


class Sighting(NamedTuple):
    """A detection that may be fused. ``vector`` is its unit vector, multiples of 2⁻²⁰ as of
    `projections.fold.exact.Units`, empty without an embedding, ``norm2`` its squared norm.
    ``depth`` is metres along the ray and its standard error; ``position`` is x, y in the map frame
    and their standard error, metres."""

    observation: ObservationOrdinal
    det_id: DetId
    class_name: str
    vector: NDArray[np.float64]
    norm2: int
    bbox: tuple[float, float, float, float]
    depth: tuple[float, float] | None = None
    position: tuple[float, float, float] | None = None


class PoseError(NamedTuple):
    """Variances and covariance of a pose's x and y, m², and variance of its heading, rad²."""

    xx: float
    xy: float
    yy: float
    yaw: float

    def along(self, cos: float, sin: float) -> float:
        """The variance of the position in the direction of a unit vector."""
        x, y = self.xx * cos + self.xy * sin, self.xy * cos + self.yy * sin
        return max(x * cos + y * sin, _LEAST_ERROR_M * _LEAST_ERROR_M)


class Sight(NamedTuple):
    """A ray from (x, y) along the unit vector (cos, sin). The variance across the ray at the
    distance a is ``a² · across_per_m2 + across_m2``. ``log_height`` is the logarithm of the box's
    height over the focal length, along the ray: + log(distance) is that of the thing's height in
    metres; None where the border cuts it. (side_cos, side_sin) is the direction from which the
    thing is seen, by line of sight or heading. ``measured`` is a distance and its variance."""

    x: float
    y: float
    cos: float
    sin: float
    across_per_m2: float
    across_m2: float
    log_height: float | None
    slope: float
    side_cos: float
    side_sin: float
    measured: tuple[float, float] | None


class Sights:
    """Makes the sights of a picture's detections."""

    def __init__(self, constants: EvidenceConstants) -> None:
        self._pose_m2 = constants.pose_m * constants.pose_m
        self._bearing_rad2 = constants.bearing_rad * constants.bearing_rad
        self._cut_rad2 = constants.bearing_cut_rad * constants.bearing_cut_rad
        self._by_heading = constants.side_by == "heading"

    def of(
        self,
        pose: Pose,
        camera: CameraConstants,
        sightings: Sequence[Sighting],
        error: PoseError | None = None,
    ) -> list[Sight]:
        """The sight of each detection; ``error`` is that of the pose, if it is known."""
        x, y = pose.x_um / 1e6, pose.y_um / 1e6
        cos, sin = cos_sin(pose.yaw_rad + camera.yaw_rad)
        half_cos, half_sin = half_field(camera.hfov_deg)
        focal = camera.width_px * 0.5 * half_cos / half_sin
        return [self._one(x, y, cos, sin, focal, camera, each, error) for each in sightings]

    def _one(
        self,
        x: float,
        y: float,
        cos: float,
        sin: float,
        focal: float,
        camera: CameraConstants,
        sighting: Sighting,
        pose_error: PoseError | None,
    ) -> Sight:
        position = sighting.position
        there = None if position is None else _position_in_range(position, x, y)
        if there is not None:
            dx, dy, error = there
            side = cos, sin
            far = math.sqrt(dx * dx + dy * dy)
            if far >= _LEAST_M:
                cos, sin = dx / far, dy / far
                if not self._by_heading:
                    side = cos, sin
            var = max(error, _LEAST_ERROR_M) * max(error, _LEAST_ERROR_M)
            measured = max(far, _LEAST_M), var
            return Sight(x, y, cos, sin, 0.0, var, None, 0.0, *side, measured)
        left, top, right, bottom = sighting.bbox
        if not (
            -_FAR_PX <= left <= _FAR_PX
            and -_FAR_PX <= top <= _FAR_PX
            and -_FAR_PX <= right <= _FAR_PX
            and -_FAR_PX <= bottom <= _FAR_PX
        ):
            left, top, right, bottom = (min(max(at, -_FAR_PX), _FAR_PX) for at in sighting.bbox)
        aside = camera.width_px * 0.5 - (left + right) * 0.5
        slant = math.sqrt(focal * focal + aside * aside)
        ahead, aside = focal / slant, aside / slant
        is_cut = left <= _CUT_PX or right >= camera.width_px - _CUT_PX
        to_cos, to_sin = cos * ahead - sin * aside, sin * ahead + cos * aside
        bearing_rad2 = self._cut_rad2 if is_cut else self._bearing_rad2
        across_m2 = along_m2 = self._pose_m2
        if pose_error is not None:
            across_m2 = pose_error.along(-to_sin, to_cos)
            along_m2 = pose_error.along(to_cos, to_sin)
            bearing_rad2 = max(bearing_rad2, min(pose_error.yaw, _MOST_BEARING_RAD2))
        log_height, slope, known = None, 0.0, None
        if sighting.depth is not None:
            depth, error = sighting.depth
            known = max(depth, _LEAST_M), error * error + along_m2
        height = bottom - top
        if height > _LEAST_PX and top > _CUT_PX and bottom < camera.height_px - _CUT_PX:
            slope = (camera.height_px - top - bottom) * 0.5 * ahead / focal
            if abs(slope) <= _STEEPEST:
                log_height = log(height * ahead / focal)
            else:
                slope = 0.0
        return Sight(
            x,
            y,
            to_cos,
            to_sin,
            bearing_rad2,
            across_m2,
            log_height,
            slope,
            cos if self._by_heading else to_cos,
            sin if self._by_heading else to_sin,
            known,
        )


def _position_in_range(
    position: tuple[float, float, float], x: float, y: float
) -> tuple[float, float, float] | None:
    """The offset of a stated position from (x, y) and its error; None where it is farther away than
    a depth may be."""
    there_x, there_y, error = position
    dx, dy = there_x - x, there_y - y
    return (dx, dy, error) if dx * dx + dy * dy <= MAX_DEPTH_M * MAX_DEPTH_M else None


_DEPTH_SIGMA_SHARE = 0.05
_LEAST_DEPTH_SIGMA_M = 0.05
_POSITION_SIGMA_M = 0.1
MOST_OF_A_PICTURE = 256
"""The most observations of one picture that are fused; the cost grows with the square."""
_MANY_TURNS = 1e6
_TURN = 2.0 * math.pi


@lru_cache(maxsize=64)
def camera_of(stated: StatedCamera | None, otherwise: CameraSettings) -> CameraConstants:
    """The camera of a picture: the one that its envelope states, else that of the settings."""
    if stated is None:
        return otherwise.constants
    return CameraConstants(
        hfov_deg=stated.hfov_deg,
        width_px=stated.width_px,
        height_px=stated.height_px,
        yaw_rad=stated.yaw_rad,
    )


def pose_of(envelope: Envelope) -> Pose | None:
    """The pose in exact micrometres; None if the envelope has none."""
    x, y, yaw = envelope.map_x, envelope.map_y, envelope.map_yaw
    if x is None or y is None or yaw is None:
        return None
    return Pose(metres_to_um(x), metres_to_um(y), yaw)


def pose_error_of(envelope: Envelope) -> PoseError | None:
    """The error of the pose that an envelope states."""
    nine = envelope.pose_covariance
    return None if nine is None else PoseError(nine[0], 0.5 * (nine[1] + nine[3]), nine[4], nine[8])


def small_angle(angle: float) -> float:
    """The angle, without most of its turns if there are very many: `cos_sin` computes the
    cosine of a small one. The remainder is exact everywhere."""
    return angle if abs(angle) <= _MANY_TURNS else math.fmod(angle, _TURN)


def with_small_yaw(pose: Pose) -> Pose:
    """The pose with its heading reduced by `small_angle`."""
    yaw = small_angle(pose.yaw_rad)
    return pose if yaw == pose.yaw_rad else Pose(pose.x_um, pose.y_um, yaw)


def sightings_of(accepted: Accepted, fusible: Sequence[FusibleObservation]) -> list[Sighting]:
    """The fusible observations of an envelope, with their boxes, depths and positions; of very
    many the first ones. The others stay observations without an Object."""
    detections = dict(zip(accepted.det_ids, accepted.envelope.detections, strict=True))
    return [
        Sighting(
            observation,
            det_id,
            class_name,
            vector,
            norm2,
            (detection := detections[det_id]).bbox,
            _depth(detection),
            _position(detection),
        )
        for observation, det_id, class_name, vector, norm2 in fusible[:MOST_OF_A_PICTURE]
    ]


def body_of(detection: Detection) -> Body | None:
    """The measured height and size of a thing; None without either."""
    z = None if detection.position is None else detection.position_z
    if z is None and detection.size is None:
        return None
    z_um = None if z is None else metres_to_um(z)
    if detection.size is None:
        return Body(z_um)
    return Body(z_um, *map(metres_to_um, detection.size))


def _depth(detection: Detection) -> tuple[float, float] | None:
    depth, sigma = detection.depth_m, detection.depth_sigma_m
    if depth is None:
        return None
    return depth, max(_LEAST_DEPTH_SIGMA_M, _DEPTH_SIGMA_SHARE * depth) if sigma is None else sigma


def _position(detection: Detection) -> tuple[float, float, float] | None:
    position, sigma = detection.position, detection.position_sigma_m
    if position is None:
        return None
    return *position, _POSITION_SIGMA_M if sigma is None else sigma
