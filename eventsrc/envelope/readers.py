"""Two readers of envelopes, by msgspec and by pydantic, with the same result.

`read_plain` reads usual envelopes in half of pydantic's time: those with known fields only, whose
texts are printable. For any other payload it returns None, and `read_checked` reads it, which also
checks unknown fields and gives the reasons of refusals. A property test compares the two on
payloads near the rules' limits.

The models define a *valid* envelope. They are strict: an int is not a string, NaN is not a number.
Unknown fields need only be JSON; they are ignored here, and the log keeps them, since it stores the
payload verbatim. The JSON schema in every segment is that of the models, docstrings included: do
not change them.
"""

from collections.abc import Callable
from typing import Annotated, Any, Final

import msgspec
from msgspec.structs import force_setattr
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    FailFast,
    Field,
    StringConstraints,
    TypeAdapter,
    model_validator,
)

from . import model


class NonFinite(Exception):
    """An unknown field holds NaN or infinity.

    No ValueError, so that pydantic stops at the first one instead of collecting a million errors.
    """


def _require_finite(value: object) -> None:
    """Raise NonFinite for NaN or infinity in an unknown field: they are not JSON, and a reader of
    the log that parses JSON would fail. Returns None: the model drops the value, the log has it."""
    if isinstance(value, float | list | dict) and model.contains_non_finite(value):
        raise NonFinite


Unknown = Annotated[Any, AfterValidator(_require_finite)]


class _Model(BaseModel):
    __pydantic_extra__: dict[str, Unknown]
    # "allow" makes pydantic check unknown fields; it costs nothing without any.
    model_config = ConfigDict(
        strict=True, frozen=True, extra="allow", allow_inf_nan=False, populate_by_name=True
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _unless_foreign(is_ours: Callable[[Any], bool]) -> BeforeValidator:
    """A field that robots may have sent with another meaning before it had one here: of another
    shape it is taken for an unknown field."""

    def own(value: object) -> object:
        if value is None or is_ours(value):
            return tuple(value) if isinstance(value, list) else value
        _require_finite(value)
        return None

    return BeforeValidator(own)


_Size = Annotated[float, Field(gt=0.0, le=model.MAX_SIZE_M)]
Size = Annotated[
    tuple[_Size, _Size, _Size] | None,
    _unless_foreign(
        lambda given: isinstance(given, list) and len(given) == 3 and all(map(_is_number, given))
    ),
]
Height = Annotated[model.Position | None, _unless_foreign(_is_number)]
Frame = Annotated[
    model.Text | None, _unless_foreign(lambda given: isinstance(given, str) and given != "")
]


class DetectionModel(_Model, title="Detection"):
    """One detected object in a keyframe.

    ``bbox`` is x_min, y_min, x_max, y_max in pixels. ``embedding`` is base64 of
    ``embedding_dim`` little-endian float32. ``depth_m`` is how far away the thing is along the ray
    through the box's centre, ``position`` its x and y in the map frame, in metres; their standard
    errors count only beside them, and so does ``position_z``, the height of its middle in that
    frame, beside ``position``. ``size`` is its length, width and height.
    """

    det_id: Annotated[model.DetId, model.TEXT] | None = None
    class_name: model.Text = Field(alias="class")
    confidence: float
    bbox: tuple[float, float, float, float]
    embedding: str | None = None
    embedding_dim: Annotated[int, Field(ge=1, le=model.MAX_DIMENSION)] | None = None
    embedding_model: model.Text | None = None
    depth_m: Annotated[float, Field(gt=0.0, le=model.MAX_DEPTH_M)] | None = None
    depth_sigma_m: Annotated[float, model.SIGMA_M] | None = None
    position: tuple[model.Position, model.Position] | None = None
    position_sigma_m: Annotated[float, model.SIGMA_M] | None = None
    position_z: Height = None
    size: Size = None


class EnvelopeCamera(_Model):
    """The level pinhole camera that took the picture: horizontal field of view, picture size, and
    the angle from the robot's heading to where it looks, to the left."""

    hfov_deg: Annotated[float, model.HFOV_DEG]
    width_px: Annotated[float, model.PIXELS]
    height_px: Annotated[float, model.PIXELS]
    yaw_rad: Annotated[float, model.ANGLE_RAD] = 0.0


class EnvelopeScan(_Model):
    """A range scan in the plane: angles in radians, to the left of where the sensor faces.

    ``ranges_mm`` is base64 of little-endian uint16, millimetres; 0 is unknown, 65535 is a beam that
    met nothing within ``range_max`` metres. ``x``, ``y`` and ``yaw`` are where the sensor is,
    metres ahead of and to the left of the pose, and radians to the left of its heading.
    """

    angle_min: Annotated[float, model.ANGLE_RAD]
    angle_step: Annotated[float, model.ANGLE_RAD]
    ranges_mm: Annotated[
        str, StringConstraints(max_length=model.MAX_RANGES_BASE64, pattern=f"^{model.BASE64}$")
    ]
    range_max: Annotated[float, Field(gt=0.0, le=1000.0)]
    x: Annotated[float, Field(ge=-100.0, le=100.0)] = 0.0
    y: Annotated[float, Field(ge=-100.0, le=100.0)] = 0.0
    yaw: Annotated[float, model.ANGLE_RAD] = 0.0


Scan = Annotated[
    EnvelopeScan | None,
    _unless_foreign(lambda given: isinstance(given, dict) and "ranges_mm" in given),
]


class EnvelopeModel(_Model, title="Envelope"):
    """One keyframe: where the robot was and what it saw.

    ``timestamp`` is the robot's time in seconds since the Unix epoch, ``map_x`` and ``map_y`` are
    metres and ``map_yaw`` radians in the map frame; all three are None when the robot has no pose.
    Without ``camera`` it is the one of the map's settings. ``floor`` names the floor that the robot
    is on; without it the height ``map_z``, metres, tells which one it is. ``pose_covariance`` is
    the error of the pose: nine numbers, the covariance of map_x, map_y and map_yaw row by row; it
    counts only beside a pose, and so does ``scan``. ``frame`` names the map frame that the pose is
    in, if robots have frames of their own.
    """

    run_id: Annotated[model.RunId, model.TEXT]
    keyframe_id: Annotated[model.KeyframeId, model.INT64]
    timestamp: Annotated[float, Field(ge=0.0, le=model.MAX_TIMESTAMP_S)]
    map_x: model.Position | None = None
    map_y: model.Position | None = None
    map_yaw: float | None = None
    camera: EnvelopeCamera | None = None
    floor: model.Floor = None
    map_z: model.Position | None = None
    pose_covariance: model.PoseCovariance | None = None
    scan: Scan = None
    frame: Frame = None
    detections: Annotated[
        tuple[DetectionModel, ...], Field(max_length=model.MAX_DETECTIONS), FailFast()
    ]

    @model_validator(mode="after")
    def _check_pose(self) -> "EnvelopeModel":
        if not (self.map_x is None) is (self.map_y is None) is (self.map_yaw is None):
            raise ValueError("map_x, map_y and map_yaw must all be numbers or all be absent")
        return self


_validate_json: Callable[[bytes], EnvelopeModel] = TypeAdapter(
    EnvelopeModel
).validator.validate_json
"""``EnvelopeModel.model_validate_json`` without its Python wrapper, a twentieth of the time."""


def read_checked(payload: bytes) -> model.Envelope:
    """The envelope in ``payload``, valid except for its embeddings. Raises pydantic's
    ValidationError, NonFinite, or RecursionError for JSON that is nested too deeply."""
    fields = dict(_validate_json(payload).__dict__)
    if (camera := fields["camera"]) is not None:
        fields["camera"] = model.StatedCamera(**camera.__dict__)
    if (scan := fields["scan"]) is not None:
        fields["scan"] = model.StatedScan(**scan.__dict__)
    fields["detections"] = tuple(
        [model.Detection(**each.__dict__) for each in fields["detections"]]
    )
    return model.Envelope(**fields)


_decode: Final = msgspec.json.Decoder(model.Envelope).decode


def read_plain(payload: bytes) -> model.Envelope | None:
    """The envelope in ``payload``, valid except for its embeddings, which are not decoded; None if
    `read_checked` must read it. Call `eventsrc.envelope.ingest.check_cost` before."""
    try:
        envelope = _decode(payload)
    except ValueError:  # msgspec's errors, and bytes that are not UTF-8
        return None
    except RecursionError:
        return None
    if not _is_plain(envelope):
        return None
    floor: object = envelope.floor
    if isinstance(floor, int):
        force_setattr(envelope, "floor", str(floor))
    return envelope


def _is_plain(envelope: model.Envelope) -> bool:
    """Whether the envelope keeps the rules that its types do not state. Texts are printable, so
    they have no control characters."""
    if not envelope.run_id.isprintable():
        return False
    if not (envelope.map_x is None) is (envelope.map_y is None) is (envelope.map_yaw is None):
        return False
    for name in (envelope.floor, envelope.frame):
        if isinstance(name, str) and not name.isprintable():
            return False
    covariance = envelope.pose_covariance
    if covariance is not None and model.covariance_fault(covariance) is not None:
        return False
    ids: list[str] = []
    for detection in envelope.detections:
        if not detection.class_name.isprintable():
            return False
        space, det_id = detection.embedding_model, detection.det_id
        if space is not None and not space.isprintable():
            return False
        if det_id is not None:
            ids.append(det_id)
    # A given id may equal another, or one generated for a detection without an id.
    return not ids or (len(set(ids)) == len(envelope.detections) and all(map(str.isprintable, ids)))
