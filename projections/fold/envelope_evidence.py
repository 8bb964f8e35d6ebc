"""The input of places and fusion from an envelope: its camera, its pose, and its detections.

A depth without a standard error has a twentieth of itself, at least 0.05 m; a position without one
has 0.1 m.
"""

import math
from collections.abc import Sequence

from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import Detection, Envelope

from .deltas import Pose
from .exact import metres_to_um
from .objects import FusibleObservation
from .settings import Camera
from .sights import PoseError, Sighting

_DEPTH_SIGMA_SHARE = 0.05
_LEAST_DEPTH_SIGMA_M = 0.05
_POSITION_SIGMA_M = 0.1
MOST_OF_A_PICTURE = 256
"""The most observations of one picture that are fused; the cost grows with the square."""
_MANY_TURNS = 1e6
_TURN = 2.0 * math.pi


def camera_of(envelope: Envelope, otherwise: Camera) -> Camera:
    """The camera that an envelope states, else ``otherwise``."""
    stated = envelope.camera
    if stated is None:
        return otherwise
    return Camera(
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
    """The angle, without most of its turns if there are very many: `exact_functions` computes the
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
