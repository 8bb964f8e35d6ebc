"""Range scans of a stream: the one nearest to a picture, as an envelope has it.

A scan has at most `MOST_BEAMS` beams, of more every n-th. Its sensor's pose is that at the scan's
own stamp, told from the pose of the keyframe.
"""

import math
from collections import deque
from typing import Any, Final, NamedTuple

import numpy as np
import pybase64
from numpy.typing import NDArray

from eventsrc.envelope.model import NO_RETURN_MM, UNKNOWN_MM

from .messages import BadMessage, frame_name, read, stamp_of
from .stream import PicturePose, PoseSource, heading
from .transforms import rotate

LASER_SCAN: Final = "sensor_msgs/msg/LaserScan"
MOST_BEAMS: Final = 360
_MOST_KEPT: Final = 64
_MOST_APART_NS: Final = 200_000_000
_MOST_AWAY_M: Final = 100.0
_DIGITS: Final = 9


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
            "angle_min": round(sign * scan.angle_min, _DIGITS),
            "angle_step": round(sign * scan.angle_step, _DIGITS),
            "ranges_mm": pybase64.b64encode(scan.ranges_mm.astype("<u2").tobytes()).decode(),
            "range_max": scan.range_max,
            "x": round(x, 6),
            "y": round(y, 6),
            "yaw": round(math.remainder(heading(sensor) - pose.yaw, math.tau), _DIGITS),
        }
