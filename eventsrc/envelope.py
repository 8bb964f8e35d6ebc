"""The envelope: one keyframe's message as it came over Zenoh (DESIGN section 3).

The models say what a *valid* envelope is. They are strict: an int is not a string, NaN is not a
number. Unknown fields need only be JSON; they are ignored here and kept in the log, which stores
the payload verbatim. Making one from bytes, with every refusal named, is the job of
`eventsrc.ingest`.
"""

import json
import unicodedata
from decimal import Decimal
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

ENVELOPE_VERSION = 2
"""The version of the models below. Older ones climb a ladder to it, see `eventsrc.upcast`."""

MAX_ID_LENGTH = 256
MAX_POSITION_M = 1e7
"""Bound of map_x and map_y, ±10,000 km: the fold computes in integer micrometres and is exact
within it (see `projections.exact`)."""
MAX_TIMESTAMP_S = 9_000_000_000.0
"""Bound of a timestamp: int nanoseconds must fit 63 bits."""
MAX_DIMENSION = 16_000
"""Bound of an embedding's dimension, pgvector's own."""


def _clean_text(value: str) -> str:
    if value.isprintable() and 0 < len(value) <= MAX_ID_LENGTH:
        return value  # the quick way out: no control character is printable
    if not value:
        raise ValueError("is empty")
    if len(value) > MAX_ID_LENGTH:
        raise ValueError(f"is {len(value)} characters long, more than {MAX_ID_LENGTH}")
    for index, char in enumerate(value):
        if unicodedata.category(char) in ("Cc", "Cs"):
            raise ValueError(f"has the control character U+{ord(char):04X} at index {index}")
    return value


Text = Annotated[str, AfterValidator(_clean_text)]
"""An id or a name: 1 to 256 characters, none of them a control character."""

Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Position = Annotated[float, Field(ge=-MAX_POSITION_M, le=MAX_POSITION_M)]


def _checked_and_forgotten(value: object) -> None:
    """Refuse NaN and infinity anywhere in an unknown field: JSON has no word for them, and whoever
    reads the log as JSON would stumble. The value is then forgotten here; the log has it."""
    try:
        json.dumps(value, allow_nan=False)
    except ValueError:
        raise ValueError("holds NaN or infinity") from None


Unknown = Annotated[Any, AfterValidator(_checked_and_forgotten)]


class _Model(BaseModel):
    __pydantic_extra__: dict[str, Unknown]
    # "allow" is what has unknown fields checked; it costs nothing where there are none.
    model_config = ConfigDict(
        strict=True, frozen=True, extra="allow", allow_inf_nan=False, populate_by_name=True
    )


class Detection(_Model):
    """One detected object in a keyframe.

    ``bbox`` is x_min, y_min, x_max, y_max in pixels. ``embedding`` is base64 of
    ``embedding_dim`` little-endian float32.
    """

    det_id: Text | None = None
    class_name: Text = Field(alias="class")
    confidence: float
    bbox: tuple[float, float, float, float]
    embedding: str | None = None
    embedding_dim: Annotated[int, Field(ge=1, le=MAX_DIMENSION)] | None = None
    embedding_model: Text | None = None


class Envelope(_Model):
    """One keyframe: where the robot was and what it saw.

    ``timestamp`` is the robot's time in seconds since the Unix epoch, ``map_x`` and ``map_y`` are
    metres and ``map_yaw`` radians in the map frame; all three are None when the robot has no pose.
    """

    run_id: Text
    keyframe_id: Int64
    timestamp: Annotated[float, Field(ge=0.0, le=MAX_TIMESTAMP_S)]
    map_x: Position | None = None
    map_y: Position | None = None
    map_yaw: float | None = None
    detections: tuple[Detection, ...]

    @model_validator(mode="after")
    def _pose_is_whole(self) -> "Envelope":
        pose = (self.map_x, self.map_y, self.map_yaw)
        if any(v is None for v in pose) and any(v is not None for v in pose):
            raise ValueError("map_x, map_y and map_yaw must all be numbers or all be absent")
        return self

    @property
    def stamp_ns(self) -> int:
        """``timestamp`` as int nanoseconds, exact to the shortest decimal that names the float."""
        return int(Decimal(repr(self.timestamp)).scaleb(9).to_integral_value())
