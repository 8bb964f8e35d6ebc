"""The envelope: one keyframe's message as it came over Zenoh.

Everything that reads envelopes gets an `Envelope`; `eventsrc.envelope.readers` defines which are
valid, and `eventsrc.envelope.ingest` makes one from bytes and gives the reason if it cannot.

The types of identifiers are here too: `Offset`, `RunId`, `KeyframeId`, `DetId`. They are ints and
strings at run time; mypy keeps them apart.
"""

import math
import unicodedata
from collections.abc import Sequence
from decimal import Decimal
from typing import TYPE_CHECKING, Annotated, NewType, TypeAlias

import msgspec
import numpy as np
import pybase64
from msgspec import Meta
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, PlainValidator, StringConstraints, WithJsonSchema
from pydantic_core import ErrorDetails

Offset = NewType("Offset", int)
"""The index of an event in its log: 0, 1, 2 … without holes. The only order and progress marker;
times and keyframe ids are data. As the end of a range it is excluded."""
FIRST_OFFSET = Offset(0)
RunId = NewType("RunId", str)
KeyframeId = NewType("KeyframeId", int)
"""The number a robot gives a keyframe within its run."""
DetId = NewType("DetId", str)

ENVELOPE_VERSION = 5
"""The version of the models below; 1 is the bare list of `eventsrc.envelope.forms`."""

MAX_ID_LENGTH = 256
MAX_POSITION_M = 1e7
"""Bound of map_x, map_y and map_z, ±10,000 km: the fold computes in integer micrometres and is
exact within it (see `projections.fold.exact`)."""
MAX_TIMESTAMP_S = 9_000_000_000.0
"""Bound of a timestamp: int nanoseconds must fit 63 bits."""
MAX_DIMENSION = 16_000
"""Bound of an embedding's dimension, pgvector's own."""
MAX_DETECTIONS = 10_000
"""Bound of the detections in one envelope; with embeddings of 512 numbers, 16 MiB hold 6,000."""


TEXT = StringConstraints(max_length=MAX_ID_LENGTH, pattern=r"^[^\x00-\x1f\x7f-\x9f]+$")
Text = Annotated[str, TEXT]
"""An id or a name: 1 to 256 characters, none of them a control character (category Cc)."""


def describe_error(error: ErrorDetails) -> str:
    """The rule that a value breaks: a `Text`'s own, else the message of pydantic."""
    if error["type"] not in ("string_too_long", "string_pattern_mismatch"):
        return error["msg"].removeprefix("Value error, ")
    text: str = error["input"]
    if not text:
        return "is empty"
    most = error.get("ctx", {}).get("max_length", MAX_ID_LENGTH)
    if len(text) > most:
        return f"is {len(text)} characters long, more than {most}"
    controls = ((i, c) for i, c in enumerate(text) if unicodedata.category(c) == "Cc")
    if (found := next(controls, None)) is None:
        return "is no base64"
    at, char = found
    return f"has the control character U+{ord(char):04X} at index {at}"


HFOV_DEG = Field(ge=1.0, le=170.0)
PIXELS = Field(ge=1.0, le=1e6)
ANGLE_RAD = Field(ge=-7.0, le=7.0)
"""Bounds of a camera's field of view, its picture's size, and the angle at which it is mounted."""
SIGMA_M = Field(ge=0.001, le=1000.0)
"""Bounds of a standard error, metres."""
MAX_DEPTH_M = 1000.0
MAX_SIZE_M = 1000.0

UNKNOWN_MM = 0
NO_RETURN_MM = 65_535
"""The range of a beam of which nothing is known, and of one that met nothing."""
MAX_BEAMS = 1440
MAX_RANGES_BASE64 = MAX_BEAMS * 2 // 3 * 4
BASE64 = "([A-Za-z0-9+/]{4})*([A-Za-z0-9+/]{2}==|[A-Za-z0-9+/]{3}=)?"

INT64 = Field(ge=-(2**63), lt=2**63)
Int64 = Annotated[int, INT64]


def _floor_name(value: object) -> str | None:
    """A floor's name: the text itself, or an integer's digits."""
    if value is None:
        return None
    if type(value) is int and -(2**63) <= value < 2**63:
        return str(value)
    if isinstance(value, str) and 1 <= len(value) <= MAX_ID_LENGTH:
        if all(unicodedata.category(char) != "Cc" for char in value):
            return value
        raise ValueError("has a control character; name the floor by a text without one")
    raise ValueError(f"is no floor; give an integer or a text of 1 to {MAX_ID_LENGTH} characters")


_FLOOR_SCHEMA = {
    "anyOf": [
        {"type": "string", "minLength": 1, "maxLength": MAX_ID_LENGTH},
        {"type": "integer"},
        {"type": "null"},
    ]
}
Floor = Annotated[str | None, PlainValidator(_floor_name), WithJsonSchema(_FLOOR_SCHEMA)]
"""The name of a floor; an integer is its decimal digits, so 2 and "2" are one floor."""

Position = Annotated[float, Field(ge=-MAX_POSITION_M, le=MAX_POSITION_M)]


COVARIANCE_SIZE = 9
MAX_VARIANCE = 1e6
"""Bound of a pose's variances: a standard error of a kilometre, or of 1000 radians."""
_SAME = 1e-6
"""How far two symmetric entries of a covariance may differ, and exceed the largest value that their
variances allow, relative to that value."""
_ROUNDING = 1e-12
"""How far rounding may move an entry beside a variance of 0, relative to the largest variance."""


def covariance_fault(nine: Sequence[float]) -> str | None:
    """Why ``nine`` numbers, row by row, are no covariance of x, y and yaw; None if they are."""
    if len(nine) != COVARIANCE_SIZE:
        return f"has {len(nine)} numbers; give {COVARIANCE_SIZE}, row by row of x, y and yaw"
    if not all(map(math.isfinite, nine)):
        return "holds NaN or infinity"
    for name, variance in zip(_OF_POSE, nine[::4], strict=True):
        if not 0.0 <= variance <= MAX_VARIANCE:
            return (
                f"has the variance {variance:g} of {name}, which is not from 0 to {MAX_VARIANCE:g}"
            )
    rounding = _ROUNDING * max(nine[::4])
    for row, column in ((0, 1), (0, 2), (1, 2)):
        one, other = nine[3 * row + column], nine[3 * column + row]
        most = math.sqrt(nine[4 * row] * nine[4 * column])
        names = f"{_OF_POSE[row]} and {_OF_POSE[column]}"
        slack = _SAME * most + rounding
        if abs(one - other) > slack:
            return f"is not symmetric: {one:g} and {other:g} for {names}"
        if abs(one) > most + slack:
            return f"has {one:g} for {names}, more than their variances allow ({most:g})"
    return None


_OF_POSE = ("x", "y", "yaw")


def _checked_covariance(nine: tuple[float, ...]) -> tuple[float, ...]:
    fault = covariance_fault(nine)
    if fault is not None:
        raise ValueError(fault)
    return nine


_COVARIANCE = Field(min_length=COVARIANCE_SIZE, max_length=COVARIANCE_SIZE)
PoseCovariance = Annotated[tuple[float, ...], _COVARIANCE, AfterValidator(_checked_covariance)]
"""Of x, y (metres) and yaw (radians), row by row."""


def contains_non_finite(value: object) -> bool:
    """Whether NaN or infinity is anywhere in a JSON value."""
    rest = [value]
    while rest:
        item = rest.pop()
        if isinstance(item, float):
            if not math.isfinite(item):
                return True
        elif isinstance(item, list):
            rest.extend(item)
        elif isinstance(item, dict):
            rest.extend(item.values())
    return False


_KnownText = Annotated[str, Meta(min_length=1, max_length=MAX_ID_LENGTH)]
_KnownPosition = Annotated[float, Meta(ge=-MAX_POSITION_M, le=MAX_POSITION_M)]
_Sigma = Annotated[float, Meta(ge=0.001, le=1000.0)]
_Size = Annotated[float, Meta(gt=0.0, le=MAX_SIZE_M)]
_Pixels = Annotated[float, Meta(ge=1.0, le=1e6)]
_Number = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
if TYPE_CHECKING:
    _Name: TypeAlias = str
else:
    _Name = _KnownText | _Number  # `eventsrc.envelope.readers` turns a number into its digits


class _Known(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True, frozen=True, gc=False):
    """A JSON object with known fields only. The types state most of the rules, see `readers`."""


class Detection(_Known, frozen=True, rename={"class_name": "class"}):
    """One detected object in a keyframe; its fields are those of `readers.DetectionModel`."""

    class_name: _KnownText
    confidence: float
    bbox: tuple[float, float, float, float]
    det_id: Annotated[DetId, Meta(min_length=1, max_length=MAX_ID_LENGTH)] | None = None
    embedding: str | None = None
    embedding_dim: Annotated[int, Meta(ge=1, le=MAX_DIMENSION)] | None = None
    embedding_model: _KnownText | None = None
    depth_m: Annotated[float, Meta(gt=0.0, le=MAX_DEPTH_M)] | None = None
    depth_sigma_m: _Sigma | None = None
    position: tuple[_KnownPosition, _KnownPosition] | None = None
    position_sigma_m: _Sigma | None = None
    position_z: _KnownPosition | None = None
    size: tuple[_Size, _Size, _Size] | None = None


class StatedCamera(_Known, frozen=True):
    """The camera that an envelope states; its fields are those of `readers.EnvelopeCamera`."""

    hfov_deg: Annotated[float, Meta(ge=1.0, le=170.0)]
    width_px: _Pixels
    height_px: _Pixels
    yaw_rad: Annotated[float, Meta(ge=-7.0, le=7.0)] = 0.0


class StatedScan(_Known, frozen=True):
    """The range scan taken with a picture; its fields are those of `readers.EnvelopeScan`."""

    angle_min: Annotated[float, Meta(ge=-7.0, le=7.0)]
    angle_step: Annotated[float, Meta(ge=-7.0, le=7.0)]
    ranges_mm: Annotated[str, Meta(max_length=MAX_RANGES_BASE64, pattern=f"^{BASE64}\\Z")]
    range_max: Annotated[float, Meta(gt=0.0, le=1000.0)]
    x: Annotated[float, Meta(ge=-100.0, le=100.0)] = 0.0
    y: Annotated[float, Meta(ge=-100.0, le=100.0)] = 0.0
    yaw: Annotated[float, Meta(ge=-7.0, le=7.0)] = 0.0

    def ranges(self) -> NDArray[np.int64]:
        """The ranges in millimetres, `UNKNOWN_MM` and `NO_RETURN_MM` among them."""
        raw = pybase64.b64decode(self.ranges_mm)
        return np.frombuffer(raw[: len(raw) // 2 * 2], "<u2").astype(np.int64)


class Envelope(_Known, frozen=True):
    """One keyframe: where the robot was and what it saw; its fields are those of
    `readers.EnvelopeModel`."""

    run_id: Annotated[RunId, Meta(min_length=1, max_length=MAX_ID_LENGTH)]
    keyframe_id: Annotated[KeyframeId, Meta(ge=-(2**63), le=2**63 - 1)]
    timestamp: Annotated[float, Meta(ge=0.0, le=MAX_TIMESTAMP_S)]
    detections: Annotated[tuple[Detection, ...], Meta(max_length=MAX_DETECTIONS)]
    map_x: _KnownPosition | None = None
    map_y: _KnownPosition | None = None
    map_yaw: float | None = None
    camera: StatedCamera | None = None
    floor: _Name | None = None
    map_z: _KnownPosition | None = None
    pose_covariance: (
        Annotated[tuple[float, ...], Meta(min_length=COVARIANCE_SIZE, max_length=COVARIANCE_SIZE)]
        | None
    ) = None
    scan: StatedScan | None = None
    frame: _KnownText | None = None

    @property
    def stamp_ns(self) -> int:
        """``timestamp`` as int nanoseconds."""
        return stamp_ns(self.timestamp)


def stamp_ns(timestamp: float) -> int:
    """Seconds as int nanoseconds, exact to the shortest decimal that names the float."""
    text = repr(timestamp)
    whole, _, part = text.partition(".")
    if 0 < len(part) <= 9 and "e" not in part:
        return int(whole + part.ljust(9, "0"))  # the same, faster
    return int(Decimal(text).scaleb(9).to_integral_value())


def has_evidence(envelope: Envelope) -> bool:
    """Whether the envelope states its camera, or a depth or position of any detection."""
    if envelope.camera is not None:
        return True
    for detection in envelope.detections:
        if detection.depth_m is not None or detection.position is not None:
            return True
    return False


def has_floor(envelope: Envelope) -> bool:
    """Whether the envelope states a floor or a height."""
    return envelope.floor is not None or envelope.map_z is not None


def has_keyframe_id(version: int) -> bool:
    """Whether payloads of this envelope version name their keyframe."""
    return version == ENVELOPE_VERSION


def default_det_id(run_id: RunId, keyframe_id: KeyframeId, index: int) -> DetId:
    """The id of a keyframe's detection ``index`` (from 0) that has none of its own."""
    return DetId(f"{run_id}_kf{keyframe_id}_d{index}")
