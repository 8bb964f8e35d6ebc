"""What a robot measured beside a picture: the solids of its detections, placed in the map, with
their boxes in the picture; and the range scan of a stream that is nearest to it.

A detection with a solid gets its position in the map frame, turned and shifted by the whole pose of
its frame, with the height of its middle. The standard error is the mean of those in x and y: by the
stated covariance, else a twentieth of the distance, at least 0.05 m; and that of the pose, if it is
stated. Without the frame's pose it gets its distance. Its size is length, width and height: the
axis that is closest to the vertical is the height, the longer one of the others the length.

A detection of a Detection3DArray gets the box around its corners in the picture, of zeros where
nothing says how the camera sees.

A scan has at most `MOST_BEAMS` beams, of more every n-th. Its sensor's pose is that at the scan's
own stamp, told from the pose of the keyframe.
"""

import math
from collections import deque
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
import pybase64
from numpy.typing import NDArray

from eventsrc.envelope.model import (
    MAX_DEPTH_M,
    MAX_POSITION_M,
    MAX_SIZE_M,
    NO_RETURN_MM,
    UNKNOWN_MM,
)

from .messages import BadMessage, Detected, Lens, Solid, frame_name, read, stamp_of
from .stream import PicturePose, PoseSource, heading, is_optical
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


LASER_SCAN: Final = "sensor_msgs/msg/LaserScan"
MOST_BEAMS: Final = 360
_MOST_KEPT: Final = 64
_MOST_APART_NS: Final = 200_000_000
_MOST_AWAY_M: Final = 100.0
_SCAN_DIGITS: Final = 9


class RangeScan(NamedTuple):
    """One scan; angles in radians, to the left of the x axis of its frame."""

    stamp_ns: int
    frame: str
    angle_min: float
    angle_step: float
    ranges_mm: NDArray[np.uint16]
    range_max: float


def scan_of(message: Any) -> RangeScan:
    """A LaserScan. Raises BadMessage for one without a beam, or with angles that are none."""
    ranges = np.asarray(message.ranges, np.float64)
    every = -(-len(ranges) // MOST_BEAMS) or 1
    ranges, step = ranges[::every], float(message.angle_increment) * every
    first, least, most = (
        float(each) for each in (message.angle_min, message.range_min, message.range_max)
    )
    if not (len(ranges) and abs(first) <= 7.0 and abs(step) <= 7.0 and 0.0 < most <= 1000.0):
        raise BadMessage(
            f"a scan of {len(ranges)} beams from {first:g} rad by {step:g}, up to {most:g} m"
        )
    nearest = least if math.isfinite(least) else 0.0
    is_far = (ranges > most) | (ranges >= NO_RETURN_MM / 1000.0)  # infinity too
    with np.errstate(invalid="ignore"):
        is_near = ~(ranges > max(nearest, 0.0))  # NaN too
    known = np.where(is_far | is_near, 0.0, ranges)
    made = np.rint(known * 1000.0).astype(np.uint16)
    made[is_far] = NO_RETURN_MM
    made[is_near] = UNKNOWN_MM
    header = message.header
    about = stamp_of(header.stamp), frame_name(header.frame_id), first, step
    return RangeScan(*about, made, most)


class KeptScans:
    """The newest scans of a stream."""

    def __init__(self) -> None:
        self._kept: deque[RangeScan] = deque(maxlen=_MOST_KEPT)
        self._latest_ns = -1

    def add(self, _topic: str, type_name: str, message: Any) -> None:
        """Keep a LaserScan. Raises BadMessage."""
        if type_name != LASER_SCAN:
            raise BadMessage(f"it is {type_name:.80}, not {LASER_SCAN}")
        scan = read(scan_of, message)
        self._kept.append(scan)
        self._latest_ns = max(self._latest_ns, scan.stamp_ns)

    def reach(self, stamp_ns: int) -> bool:
        """Whether a scan of this stamp or later was kept."""
        return self._latest_ns >= stamp_ns

    def at(self, stamp_ns: int, pose: PicturePose, poses: PoseSource) -> dict[str, Any] | None:
        """The scan of a keyframe with a pose; None where there is none near, or its frame has no
        pose."""
        scan = min(self._kept, key=lambda each: abs(each.stamp_ns - stamp_ns), default=None)
        if scan is None or abs(scan.stamp_ns - stamp_ns) > _MOST_APART_NS:
            return None
        there = poses.at(scan.stamp_ns, scan.frame, final=True)
        if there is None or there.camera is None:
            return None
        sensor = there.camera
        sign = 1.0 if rotate(sensor, 0.0, 0.0, 1.0)[2] >= 0.0 else -1.0  # one that hangs
        dx, dy = sensor.x - pose.x, sensor.y - pose.y
        cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        if max(abs(x), abs(y)) > _MOST_AWAY_M:
            return None
        return {
            "angle_min": round(sign * scan.angle_min, _SCAN_DIGITS),
            "angle_step": round(sign * scan.angle_step, _SCAN_DIGITS),
            "ranges_mm": pybase64.b64encode(scan.ranges_mm.astype("<u2").tobytes()).decode(),
            "range_max": scan.range_max,
            "x": round(x, 6),
            "y": round(y, 6),
            "yaw": round(math.remainder(heading(sensor) - pose.yaw, math.tau), _SCAN_DIGITS),
        }
