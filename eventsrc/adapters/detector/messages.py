"""Read messages with pictures and poses that robots publish over Zenoh.

Pictures: a JPEG or PNG as it is, or in CDR sensor_msgs/CompressedImage or sensor_msgs/Image, as a
bridge of ROS 2 forwards them. Without a stamp of its own a picture has its time of receipt.

Poses: JSON with ``x``, ``y``, ``yaw`` (or ``map_x`` …) and ``stamp`` or ``timestamp``, or in CDR
geometry_msgs/PoseStamped, PoseWithCovarianceStamped or nav_msgs/Odometry. The type of a message
follows from its length.
"""

import json
import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from eventsrc.envelope.cdr import CdrFault, CdrFields, is_cdr
from eventsrc.envelope.model import MAX_POSITION_M, MAX_TIMESTAMP_S

from .gate import Pose
from .picture import MAX_PICTURE_PIXELS, Picture, Pixels
from .vision import colour_order, decode

_POSE_BYTES: Final = 56
_COVARIANCE_BYTES: Final = 288
_TWIST_BYTES: Final = 48 + _COVARIANCE_BYTES
_MOST_PADDING: Final = 3
_CHANNELS: Final[Mapping[str, int]] = {"bgr8": 3, "rgb8": 3, "8UC3": 3, "mono8": 1, "8UC1": 1}
_NORM_SLACK: Final = 0.1


class MessageError(ValueError):
    """A message that is no picture or no pose; the text is the reason."""


def picture_of(payload: bytes, name: str, received_s: float) -> Picture:
    """The picture of a message, not decoded. Raises MessageError if its header cannot be read."""
    if not is_cdr(payload):
        return Picture(name, received_s, lambda: decode(payload))
    try:
        return _compressed(payload, name, received_s)
    except CdrFault as first:
        try:
            return _raw(payload, name, received_s)
        except CdrFault as second:
            raise MessageError(
                f"neither sensor_msgs/CompressedImage ({first}) nor sensor_msgs/Image ({second})"
            ) from None


def _compressed(payload: bytes, name: str, received_s: float) -> Picture:
    fields = CdrFields(payload)
    stamp_s = _stamp(fields, received_s)
    fields.text("format")
    (length,) = fields.numbers("I", "the length of data")
    data = bytes(fields.last(length, "data"))
    return Picture(name, stamp_s, lambda: decode(data))


def _raw(payload: bytes, name: str, received_s: float) -> Picture:
    fields = CdrFields(payload)
    stamp_s = _stamp(fields, received_s)
    height, width = fields.numbers("II", "height and width")
    encoding = fields.text("encoding").decode("utf-8", "replace")
    fields.numbers("B", "is_bigendian")
    step, length = fields.numbers("II", "step and the length of data")
    data = fields.last(length, "data")
    if encoding not in _CHANNELS:
        raise MessageError(
            f"sensor_msgs/Image of encoding {encoding[:40]!r}; {', '.join(_CHANNELS)} can be read"
        )
    channels = _CHANNELS[encoding]
    if not 0 < width * height <= MAX_PICTURE_PIXELS or step < width * channels:
        raise MessageError(f"sensor_msgs/Image of {width:,} × {height:,} pixels, step {step:,}")
    if length != step * height:
        raise MessageError(f"sensor_msgs/Image of {length:,} bytes instead of {step * height:,}")

    def pixels() -> Pixels:
        rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, : width * channels]
        shaped = np.ascontiguousarray(rows).reshape(height, width, channels)
        if channels == 1:
            return colour_order(shaped, "mono")
        return colour_order(shaped, "rgb") if encoding == "rgb8" else shaped

    return Picture(name, stamp_s, pixels)


def pose_of(payload: bytes, received_s: float) -> tuple[float, Pose]:
    """Stamp, in seconds, and pose of a message. Raises MessageError."""
    if is_cdr(payload):
        try:
            return _pose_of_cdr(CdrFields(payload), received_s)
        except CdrFault as fault:
            raise MessageError(f"no pose in CDR: {fault}") from None
    return _pose_of_json(payload, received_s)


def _pose_of_cdr(fields: CdrFields, received_s: float) -> tuple[float, Pose]:
    stamp_s = _stamp(fields, received_s)
    if not _is_length(fields.left(8), _POSE_BYTES, _POSE_BYTES + _COVARIANCE_BYTES):
        fields.text("child_frame_id")
        if not _is_length(fields.left(8), _POSE_BYTES + _COVARIANCE_BYTES + _TWIST_BYTES):
            raise MessageError(
                "a message in CDR of another length than geometry_msgs/PoseStamped, "
                "PoseWithCovarianceStamped and nav_msgs/Odometry have"
            )
    x, y, _ = fields.numbers("ddd", "position")
    return stamp_s, _checked(x, y, _yaw(fields.numbers("dddd", "orientation")))


def _is_length(left: int, *lengths: int) -> bool:
    """Whether ``left`` bytes are one of ``lengths``, or that plus padding."""
    return any(length <= left <= length + _MOST_PADDING for length in lengths)


def _stamp(fields: CdrFields, received_s: float) -> float:
    """The stamp of a header in seconds, ``received_s`` if it is zero. Skips the frame."""
    seconds, nanoseconds = fields.numbers("iI", "header.stamp")
    fields.text("header.frame_id")
    if seconds < 0 or nanoseconds >= 1_000_000_000:
        raise CdrFault(f"header.stamp is {seconds} s and {nanoseconds} ns")
    return received_s if seconds == nanoseconds == 0 else seconds + nanoseconds / 1e9


def _yaw(quaternion: tuple[float, ...]) -> float:
    norm = math.sqrt(math.fsum(q * q for q in quaternion))
    if not abs(norm - 1.0) <= _NORM_SLACK:
        raise MessageError(f"a pose whose quaternion has length {norm:.3g} instead of 1")
    x, y, z, w = (q / norm for q in quaternion)
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _pose_of_json(payload: bytes, received_s: float) -> tuple[float, Pose]:
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError):
        raise MessageError("a pose that is neither JSON nor CDR") from None
    if not isinstance(document, dict):
        raise MessageError("a pose that is no JSON object")
    numbers = [_first(document, names) for names in (("x", "map_x"), ("y", "map_y"))]
    yaw = _first(document, ("yaw", "map_yaw"))
    stamp = _first(document, ("stamp", "timestamp"))
    if None in numbers or yaw is None:
        raise MessageError("a pose without the numbers x, y and yaw")
    stamp_s = received_s if stamp is None else stamp
    if not 0.0 <= stamp_s <= MAX_TIMESTAMP_S:
        raise MessageError(f"a pose with the stamp {stamp_s:g}, which is no Unix time")
    return stamp_s, _checked(float(numbers[0] or 0.0), float(numbers[1] or 0.0), yaw)


def _first(document: Mapping[str, Any], names: tuple[str, ...]) -> float | None:
    for name in names:
        value = document.get(name)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return _float(value)
    return None


def _float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _checked(x: float, y: float, yaw: float) -> Pose:
    if not (abs(x) <= MAX_POSITION_M and abs(y) <= MAX_POSITION_M and math.isfinite(yaw)):
        raise MessageError(f"a pose at x {x:g}, y {y:g}, yaw {yaw:g}")
    return Pose(x, y, yaw)
