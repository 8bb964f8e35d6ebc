"""Read the fields of decoded ROS messages as plain values.

A message is any object with the attributes of its definition, such as one that rosbags decodes. A
field that is missing or of another type raises BadMessage; NaN is kept, and the log's validation
refuses it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
import pybase64
from pydantic_core import from_json

from eventsrc.envelope.model import covariance_fault

from .transforms import BadTransform, Transform, unit_transform

DETECTIONS: Final = "vision_msgs/msg/Detection2DArray"
DETECTIONS_3D: Final = "vision_msgs/msg/Detection3DArray"
DETECTION_TYPES: Final = (DETECTIONS, DETECTIONS_3D)
LABELS: Final = "vision_msgs/msg/LabelInfo"
VISION_INFO: Final = "vision_msgs/msg/VisionInfo"
PARAMETERS: Final = "rcl_interfaces/msg/ParameterEvent"
TF: Final = "tf2_msgs/msg/TFMessage"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
POSE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
GRID: Final = "nav_msgs/msg/OccupancyGrid"
TEXT: Final = "std_msgs/msg/String"
FLOATS: Final = "std_msgs/msg/Float32MultiArray"

UNCLASSIFIED: Final = "unclassified"
"""The class of a detection without a hypothesis."""
_POSE_OF_6D: Final = (0, 1, 5, 6, 7, 11, 30, 31, 35)
"""Indices of x, y and yaw in the covariance of x, y, z, roll, pitch and yaw, row by row."""
_X_Y_Z_OF_6D: Final = (0, 1, 2, 6, 7, 8, 12, 13, 14)
_NS: Final = 1_000_000_000
_NS_DIGITS: Final = 9

_Read = TypeVar("_Read")

Covariance = tuple[float, ...]
"""Nine numbers, row by row: of x, y (metres) and yaw (radians)."""


class BadMessage(ValueError):
    """A message that does not fit its type or has an invalid value; the text is the reason."""


class Stamped(NamedTuple):
    """One transform of a TFMessage, with its stamp."""

    parent: str
    child: str
    stamp_ns: int
    pose: Transform


class StampedPose(NamedTuple):
    """A pose of odometry or localisation. ``child`` is empty if the message names no child frame.
    ``fault`` is the reason why its covariance is unusable; None if it is usable or all zeros."""

    parent: str
    child: str
    stamp_ns: int
    pose: Transform
    covariance: Covariance | None
    fault: str | None = None


class Lens(NamedTuple):
    """Field of view and picture size of a camera, from CameraInfo."""

    frame: str
    hfov_deg: float
    width_px: float
    height_px: float


class StampedEmbeddings(NamedTuple):
    """The embeddings of one Detection2DArray: base64 of float32 by index, or by Detection2D.id."""

    stamp_ns: int
    model: str | None
    dim: int | None
    by_index: Sequence[str | None]
    by_id: Mapping[str, str | None] | None
    """By Detection2D.id; None if they are by index."""


class Solid(NamedTuple):
    """Where a detected thing is, in the frame of its message: its middle and its axes, the
    covariance of x, y and z if it is known, and its lengths along its axes if they are."""

    pose: Transform
    covariance: tuple[float, ...] | None
    size: tuple[float, float, float] | None


class Detected(NamedTuple):
    """A Detection2DArray or Detection3DArray. ``detections`` are as in an envelope, without
    embeddings, and ``ids`` the id of each. Boxes of a Detection3DArray are all zeros."""

    stamp_ns: int
    frame: str
    detections: list[dict[str, Any]]
    ids: list[str]
    unclassified: int
    solids: list[Solid | None]
    has_boxes: bool = True


def stamp_of(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return _integer(stamp.sec) * _NS + _integer(stamp.nanosec)


def frame_name(name: Any) -> str:
    """A frame's name without the leading slash of ROS 1."""
    if not isinstance(name, str):
        raise BadMessage(f"a frame's name is {type(name).__name__}, not text")
    return name.removeprefix("/")


def read(reader: Callable[[Any], _Read], message: Any) -> _Read:
    """``reader(message)``; raises BadMessage if the message lacks a field of its type."""
    try:
        return reader(message)
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        if isinstance(error, BadMessage):
            raise
        raise BadMessage(str(error)) from None


def transform_of(each: Any) -> Stamped:
    """A TransformStamped, one of the ``transforms`` of a TFMessage."""
    return Stamped(
        frame_name(each.header.frame_id),
        frame_name(each.child_frame_id),
        stamp_of(each.header.stamp),
        _transform(each.transform.translation, each.transform.rotation),
    )


def pose_of(message: Any) -> StampedPose:
    """The pose of an Odometry or a PoseWithCovarianceStamped."""
    at, nine = message.pose.pose, _of_x_y_yaw(message.pose.covariance)
    fault = covariance_fault(nine) if any(nine) else None
    return StampedPose(
        frame_name(message.header.frame_id),
        frame_name(getattr(message, "child_frame_id", "")),
        stamp_of(message.header.stamp),
        _transform(at.position, at.orientation),
        nine if any(nine) and fault is None else None,
        None if fault is None else f"the pose's covariance {fault}",
    )


def lens_of(message: Any) -> Lens:
    """The camera of a CameraInfo. Raises BadMessage for one that is not calibrated."""
    width, height, fx = float(message.width), float(message.height), float(message.k[0])
    hfov = round(math.degrees(2.0 * math.atan(width / 2.0 / fx)), 9) if fx > 0.0 else 0.0
    if not (width > 0.0 and height > 0.0 and hfov > 0.0):
        raise BadMessage(f"a camera of {width:g} × {height:g} pixels with k[0] = {fx:g}")
    return Lens(frame_name(message.header.frame_id), hfov, width, height)


def detections_of(message: Any) -> Detected:
    """The detections of a Detection2DArray of vision_msgs 2, 3 or 4, or of a Detection3DArray. Of
    several hypotheses the one with the highest score counts, of equal ones the first; its class is
    the id as it is."""
    made: list[dict[str, Any]] = []
    ids: list[str] = []
    solids: list[Solid | None] = []
    unclassified, has_boxes = 0, True
    for each in message.detections:
        class_name, score, given = _best(each.results)
        unclassified += class_name == UNCLASSIFIED
        has_boxes = not hasattr(each.bbox, "size")
        bbox = _box(each.bbox) if has_boxes else [0.0] * 4
        made.append({"class": class_name, "confidence": score, "bbox": bbox})
        ids.append(str(getattr(each, "id", "")))
        solids.append(_solid(given, None if has_boxes else each.bbox))
    header = message.header
    of = stamp_of(header.stamp), frame_name(header.frame_id)
    return Detected(*of, made, ids, unclassified, solids, has_boxes)


def embeddings_of_text(message: Any) -> StampedEmbeddings:
    """The embeddings of a std_msgs/String of JSON; docs/ros.md has the form."""
    document = from_json(message.data, cache_strings="keys")
    if not isinstance(document, dict) or "stamp" not in document:
        raise BadMessage('the embeddings are no JSON object with a "stamp"')
    stamp, given = document["stamp"], document.get("embeddings")
    stamp_ns = _integer(stamp["sec"]) * _NS + _integer(stamp["nanosec"])
    model, dim = document.get("model"), document.get("dim")
    if isinstance(given, list):
        by_index = [_base64(each) for each in given]
        return StampedEmbeddings(stamp_ns, model, dim, by_index, None)
    if isinstance(given, dict):
        by_id = {name: _base64(each) for name, each in given.items()}
        return StampedEmbeddings(stamp_ns, model, dim, (), by_id)
    raise BadMessage('"embeddings" is neither a list nor an object')


def embeddings_of_floats(message: Any) -> StampedEmbeddings:
    """The embeddings of a std_msgs/Float32MultiArray, a row for each detection. The label of its
    first dimension is the stamp, as ``1714557600.250000000``; that of its second, the model."""
    rows, columns = message.layout.dim
    seconds, dot, fraction = rows.label.partition(".")
    if not (dot and seconds.isdecimal() and fraction.isdecimal() and len(fraction) == _NS_DIGITS):
        raise BadMessage(
            f"the label of dimension 0 is {rows.label[:40]!r}, not a stamp as seconds, a dot and "
            "nine digits of nanoseconds"
        )
    count, dim = int(rows.size), int(columns.size)
    values = np.asarray(message.data, "<f4")
    if (
        count < 0
        or dim < 1 <= count
        or message.layout.data_offset != 0
        or values.size != count * dim
    ):
        raise BadMessage(f"{values.size:,} values where {count:,} × {dim:,} are declared")
    raw, size = values.tobytes(), 4 * dim
    by_index = [
        pybase64.b64encode(raw[at * size : (at + 1) * size]).decode() for at in range(count)
    ]
    return StampedEmbeddings(
        int(seconds) * _NS + int(fraction), columns.label or None, dim, by_index, None
    )


def _best(results: Sequence[Any]) -> tuple[str, float, Any]:
    """Class, score and PoseWithCovariance of the best hypothesis."""
    best, class_id, pose = -math.inf, None, None
    for result in results:
        hypothesis = getattr(result, "hypothesis", result)  # vision_msgs 2 has none
        score = float(hypothesis.score)
        if class_id is None or score > best or math.isnan(best):
            best, pose = score, getattr(result, "pose", None)
            class_id = str(
                hypothesis.class_id if hasattr(hypothesis, "class_id") else hypothesis.id
            )
    if not class_id:
        return UNCLASSIFIED, max(best, 0.0), pose
    return class_id, best, pose


def _solid(given: Any, bbox: Any) -> Solid | None:
    """Where a thing is by the middle of its BoundingBox3D, else by the pose of its hypothesis;
    None where neither says so: a position of zeros or NaN is unknown."""
    boxed = None if bbox is None else _pose_of_thing(bbox.center)
    pose = boxed or (None if given is None else _pose_of_thing(given.pose))
    if pose is None:
        return None
    values = () if given is None else tuple(float(given.covariance[at]) for at in _X_Y_Z_OF_6D)
    is_known = any(values) and all(map(math.isfinite, values)) and min(values[::4]) >= 0.0
    size = None
    if boxed is not None:
        x, y, z = (float(part) for part in (bbox.size.x, bbox.size.y, bbox.size.z))
        size = (x, y, z) if min(x, y, z) > 0.0 and math.isfinite(x + y + z) else None
    return Solid(pose, values if is_known else None, size)


def _pose_of_thing(pose: Any) -> Transform | None:
    at, turn = pose.position, pose.orientation
    x, y, z = float(at.x), float(at.y), float(at.z)
    if not (x or y or z):
        return None
    try:
        return unit_transform(
            x, y, z, *(float(turn.x), float(turn.y), float(turn.z), float(turn.w))
        )
    except BadTransform:
        pass
    try:  # a detector that knows no orientation may leave it all zeros
        return unit_transform(x, y, z, 0.0, 0.0, 0.0, 1.0)
    except BadTransform:
        return None


def _box(bbox: Any) -> list[float]:
    """Left, top, right and bottom of the upright box around a box that may be rotated."""
    center, width, height = bbox.center, float(bbox.size_x), float(bbox.size_y)
    at = getattr(center, "position", center)  # a geometry_msgs/Pose2D before vision_msgs 4
    theta = float(center.theta)
    if theta != 0.0:
        if not math.isfinite(theta):
            return [theta] * 4
        cos, sin = abs(math.cos(theta)), abs(math.sin(theta))
        width, height = width * cos + height * sin, width * sin + height * cos
    x, y = float(at.x), float(at.y)
    return [x - width / 2.0, y - height / 2.0, x + width / 2.0, y + height / 2.0]


def _transform(position: Any, rotation: Any) -> Transform:
    return unit_transform(
        position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w
    )


def _of_x_y_yaw(values: Sequence[float]) -> Covariance:
    """x, y and yaw of a 6 × 6 covariance."""
    return tuple(float(values[at]) for at in _POSE_OF_6D)


def _integer(value: Any) -> int:
    if type(value) is int:
        return value
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise BadMessage(f"a stamp holds {value!r:.40}, not an integer")
    return int(value)


def _base64(value: Any) -> str | None:
    if value is None or isinstance(value, str):
        return value
    raise BadMessage(f"an embedding is {type(value).__name__}, not base64 text or null")
