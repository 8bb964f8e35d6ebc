"""Measured things: where the solids of detections are in the map, and their boxes in the picture.

A detection with a solid gets its position in the map frame, turned and shifted by the whole pose of
its frame, with the height of its middle. The standard error is the mean of those in x and y: by the
stated covariance, else a twentieth of the distance, at least 0.05 m; and that of the pose, if it is
stated. Without the frame's pose it gets its distance. Its size is length, width and height: the
axis that is closest to the vertical is the height, the longer one of the others the length.

A detection of a Detection3DArray gets the box around its corners in the picture, of zeros where
nothing says how the camera sees.
"""

import math
from itertools import product
from typing import Any, Final

from eventsrc.envelope.model import MAX_DEPTH_M, MAX_POSITION_M, MAX_SIZE_M

from .messages import Detected, Lens, Solid
from .stream import PicturePose, is_optical
from .transforms import Transform, compose, rotate

_SIGMA_SHARE: Final = 0.05
_LEAST_SIGMA_M: Final = 0.05
_SIGMA_BOUNDS_M: Final = (0.001, 1000.0)
_NEAREST_M: Final = 0.1
"""Corners nearer to the camera's plane count as this far from it."""
_DIGITS: Final = 6


def place_solids(detected: Detected, pose: PicturePose | None, lens: Lens | None) -> int:
    """Add to the detections what their solids say; returns how many have a position."""
    camera, count = None if pose is None else pose.camera, 0
    for detection, solid in zip(detected.detections, detected.solids, strict=True):
        if solid is None or not 0.0 < _distance(solid) <= MAX_DEPTH_M:
            continue
        if not detected.has_boxes and lens is not None:
            detection["bbox"] = _box(solid, lens, is_optical(camera, detected.frame))
        if camera is not None and pose is not None:
            position = _in_map(solid, camera, pose)
            count += bool(position)
            detection |= position
        elif any(detection["bbox"]):
            detection |= _along_ray(solid)
    return count


def _distance(solid: Solid) -> float:
    at = solid.pose
    return math.sqrt(at.x * at.x + at.y * at.y + at.z * at.z)


def _in_map(solid: Solid, camera: Transform, pose: PicturePose) -> dict[str, Any]:
    at = compose(camera, solid.pose)
    if not all(abs(part) <= MAX_POSITION_M for part in (at.x, at.y, at.z)):
        return {}
    dx, dy = at.x - camera.x, at.y - camera.y
    variance = _variance(solid, camera)
    if (own := pose.covariance) is not None:
        variance += 0.5 * (own[0] + own[4] + own[8] * (dx * dx + dy * dy))
    fields: dict[str, Any] = {
        "position": [round(at.x, _DIGITS), round(at.y, _DIGITS)],
        "position_sigma_m": _sigma(variance),
        "position_z": round(at.z, _DIGITS),
    }
    if solid.size is not None and max(solid.size) <= MAX_SIZE_M:
        axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        upright = max(range(3), key=lambda axis: abs(rotate(at, *axes[axis])[2]))
        height = solid.size[upright]
        flat = sorted(part for axis, part in enumerate(solid.size) if axis != upright)
        fields["size"] = [flat[1], flat[0], height]
    return fields


def _variance(solid: Solid, camera: Transform) -> float:
    """The mean of the variances in x and y of the map."""
    nine = solid.covariance
    if nine is None:
        return max(_LEAST_SIGMA_M, _SIGMA_SHARE * _distance(solid)) ** 2
    axes = [rotate(camera, *(float(a == b) for b in range(3))) for a in range(3)]
    return 0.5 * sum(
        axes[a][each] * nine[3 * a + b] * axes[b][each]
        for each, a, b in product(range(2), range(3), range(3))
    )


def _along_ray(solid: Solid) -> dict[str, Any]:
    far, nine = _distance(solid), solid.covariance
    fields: dict[str, Any] = {"depth_m": round(far, _DIGITS)}
    if nine is not None:
        ray = tuple(part / far for part in solid.pose[:3])
        variance = sum(ray[a] * nine[3 * a + b] * ray[b] for a, b in product(range(3), range(3)))
        fields["depth_sigma_m"] = _sigma(variance)
    return fields


def _sigma(variance: float) -> float:
    least, most = _SIGMA_BOUNDS_M
    return round(min(max(math.sqrt(max(variance, 0.0)), least), most), _DIGITS)


def _box(solid: Solid, lens: Lens, optical: bool) -> list[float]:
    focal = lens.width_px * 0.5 / math.tan(math.radians(lens.hfov_deg) * 0.5)
    ahead = solid.pose.z if optical else solid.pose.x
    if ahead < _NEAREST_M:
        return [0.0] * 4
    half = [0.5 * part for part in solid.size or (0.0, 0.0, 0.0)]
    across, down = [], []
    for signs in product((-1.0, 1.0), repeat=3):
        dx, dy, dz = rotate(solid.pose, *(s * h for s, h in zip(signs, half, strict=True)))
        x, y, z = solid.pose.x + dx, solid.pose.y + dy, solid.pose.z + dz
        right, below, far = (x, y, z) if optical else (-y, -z, x)
        far = max(far, _NEAREST_M)
        across.append(min(max(0.5 * lens.width_px + focal * right / far, 0.0), lens.width_px))
        down.append(min(max(0.5 * lens.height_px + focal * below / far, 0.0), lens.height_px))
    box = [min(across), min(down), max(across), max(down)]
    is_outside = box[0] == box[2] == lens.width_px or box[0] == box[2] == 0.0
    return [0.0] * 4 if is_outside else [round(part, 3) for part in box]
