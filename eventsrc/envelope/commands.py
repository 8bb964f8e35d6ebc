"""Commands: corrections of the map by a person or a SLAM back end, as events on
``mapfold/command``.

A command is appended like any event and never changed. It refers to places and objects by keyframes
and det_ids, which are in the log, never by ids of places or objects, which differ from fold to
fold. `projections.fold.corrections` compiles commands to what the fold obeys; docs/corrections.md
describes them.
"""

import math
from collections.abc import Callable
from typing import Annotated, Literal, TypeAlias

from pydantic import (
    BaseModel,
    ConfigDict,
    FailFast,
    Field,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import from_json

from .model import (
    INT64,
    MAX_DIMENSION,
    TEXT,
    DetId,
    KeyframeId,
    Offset,
    Position,
    RunId,
    Text,
    describe_error,
)

MAX_REASON = 2_000
MAX_NAMED = 100_000
"""Bound of the keyframes or det_ids in one command."""
MAX_LABELS = 10_000
"""Bound of the labels in one command."""
MAX_YAW_RAD = 10_000.0
"""Bound of a corrected yaw and of a turn: a larger one is no angle but a mistake."""
_MOST_SHOWN = 80
_MAX_ROTATION_ERROR = 1e-9
_BIDI_CONTROLS = frozenset(
    "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
)
MAX_COMMAND_BYTES = 16 * 1024 * 1024
MAX_JSON_VALUES = 2_000_000
"""Bound of the values in a command, counted as commas and opening brackets."""
MAX_JSON_FIELDS = 100
"""Bound of the fields of one JSON object in a command."""
_UNCOUNTED_BYTES = 64 * 1024
"""In payloads up to this size values and fields are not counted."""


class _Model(BaseModel):
    model_config = ConfigDict(
        strict=True, frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True
    )


class Anchor(_Model):
    """A keyframe that stands for the place that it is in. A place's own anchor is its founder."""

    run_id: Annotated[RunId, TEXT]
    keyframe_id: Annotated[KeyframeId, INT64]


class _Command(_Model):
    """The fields of every command. ``command_id`` is unique in the log."""

    command_id: Text
    issued_by: Text
    reason: Annotated[str, Field(max_length=MAX_REASON)] = ""


DetIds: TypeAlias = Annotated[
    tuple[Annotated[DetId, TEXT], ...], Field(min_length=1, max_length=MAX_NAMED), FailFast()
]
Pair: TypeAlias = tuple[Anchor, Anchor]
DetPair: TypeAlias = tuple[Annotated[DetId, TEXT], Annotated[DetId, TEXT]]


class NamePlace(_Command):
    """The place of ``place`` is called ``name``."""

    kind: Literal["name-place"] = "name-place"
    place: Anchor
    name: Text

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        if not name.strip():
            raise ValueError("a name must not be blank")
        if not _BIDI_CONTROLS.isdisjoint(name):
            raise ValueError("a name must not have characters that change the direction of text")
        return name


class KeepApart(_Command):
    """The places of the two anchors are never one."""

    kind: Literal["keep-apart"] = "keep-apart"
    places: Pair


class UndoMerge(_Command):
    """The places that the merge at ``merge_offset`` made one are never one."""

    kind: Literal["undo-merge"] = "undo-merge"
    merge_offset: Annotated[Offset, INT64]
    places: Annotated[tuple[Anchor, ...], Field(min_length=2, max_length=1000), FailFast()]


class Join(_Command):
    """The places of the two anchors are one, though no chain of poses joins them."""

    kind: Literal["join"] = "join"
    places: Pair


class SameObject(_Command):
    """The Objects of two detections are one."""

    kind: Literal["same-object"] = "same-object"
    det_ids: DetPair


class DifferentObjects(_Command):
    """The Objects of two detections are never one."""

    kind: Literal["different-objects"] = "different-objects"
    det_ids: DetPair


class DropObject(_Command):
    """An Object that does not exist: the detections that it had when the command was given are left
    out of the map."""

    kind: Literal["drop-object"] = "drop-object"
    det_ids: DetIds


class DropDetection(_Command):
    """Detections that are left out of the map; the log keeps them."""

    kind: Literal["drop-detection"] = "drop-detection"
    det_ids: DetIds


class ForgetRun(_Command):
    """A run that is left out of every fold."""

    kind: Literal["forget-run"] = "forget-run"
    run_id: Annotated[RunId, TEXT]


class ForgetKeyframes(_Command):
    """Keyframes ``first`` to ``last`` of a run, both included, are left out of every fold."""

    kind: Literal["forget-keyframes"] = "forget-keyframes"
    run_id: Annotated[RunId, TEXT]
    first: Annotated[KeyframeId, INT64]
    last: Annotated[KeyframeId, INT64]

    @model_validator(mode="after")
    def _check_range(self) -> "ForgetKeyframes":
        if self.last < self.first:
            raise ValueError("first must not be more than last")
        return self


Yaw: TypeAlias = Annotated[float, Field(ge=-MAX_YAW_RAD, le=MAX_YAW_RAD)]


class CorrectedPose(_Model):
    """A keyframe's corrected pose: metres and radians in the map frame of its run."""

    keyframe_id: Annotated[KeyframeId, INT64]
    x: Position
    y: Position
    yaw: Yaw


class RigidTransform(_Model):
    """x' = cos·x − sin·y + dx, y' = sin·x + cos·y + dy, yaw' = yaw + dyaw.

    Metres and radians. Cosine and sine are part of the command, because computing them in the fold
    could give another last bit on another machine.
    """

    dx: Position
    dy: Position
    dyaw: Yaw
    cos: Annotated[float, Field(ge=-1.0, le=1.0)]
    sin: Annotated[float, Field(ge=-1.0, le=1.0)]

    @model_validator(mode="after")
    def _check_rotation(self) -> "RigidTransform":
        cos, sin, most = self.cos, self.sin, _MAX_ROTATION_ERROR
        if abs(cos * cos + sin * sin - 1.0) > most:
            raise ValueError("cos² + sin² must be 1")
        if abs(cos - math.cos(self.dyaw)) > most or abs(sin - math.sin(self.dyaw)) > most:
            raise ValueError("cos and sin must be those of dyaw")
        return self

    @classmethod
    def of(cls, dx: float, dy: float, dyaw: float) -> "RigidTransform":
        """The transform with cosine and sine computed from ``dyaw``."""
        return cls(dx=dx, dy=dy, dyaw=dyaw, cos=math.cos(dyaw), sin=math.sin(dyaw))


class CorrectPoses(_Command):
    """Corrected poses of a run: a pose for each of some keyframes, or one rigid transform of all
    its keyframes, of ``first`` to ``last`` where these are given (both included)."""

    kind: Literal["correct-poses"] = "correct-poses"
    run_id: Annotated[RunId, TEXT]
    poses: Annotated[tuple[CorrectedPose, ...], Field(max_length=1_000_000), FailFast()] = ()
    transform: RigidTransform | None = None
    first: Annotated[KeyframeId, INT64] | None = None
    last: Annotated[KeyframeId, INT64] | None = None

    @model_validator(mode="after")
    def _check_one(self) -> "CorrectPoses":
        if bool(self.poses) == (self.transform is not None):
            raise ValueError("give either poses or a transform")
        if self.first is not None and self.last is not None and self.last < self.first:
            raise ValueError("first must not be more than last")
        return self


class JoinFrames(_Command):
    """All keyframes whose envelopes name the map frame ``frame`` are moved into the frame ``into``,
    None for the map's own."""

    kind: Literal["join-frames"] = "join-frames"
    frame: Text
    into: Text | None = None
    transform: RigidTransform

    @model_validator(mode="after")
    def _check_two(self) -> "JoinFrames":
        if self.frame == self.into:
            raise ValueError("frame and into must be two frames")
        return self


class Relabel(_Command):
    """Names of classes: a detection that was recorded with the first text of a pair as its class
    has the second one in the map."""

    kind: Literal["relabel"] = "relabel"
    labels: Annotated[
        tuple[tuple[Text, Text], ...], Field(min_length=1, max_length=MAX_LABELS), FailFast()
    ]

    @model_validator(mode="after")
    def _check_once(self) -> "Relabel":
        seen: set[str] = set()
        for label, _ in self.labels:
            if label in seen:
                raise ValueError(f"label {label!r} is named twice")
            seen.add(label)
        return self


class UseSettings(_Command):
    """The map's settings from here on; ``settings`` as `projections.fold.settings` reads them."""

    kind: Literal["use-settings"] = "use-settings"
    settings: dict[str, object]


class Reembed(_Command):
    """The vectors of ``space`` in the events on ``mapfold/embeddings`` from offset ``first`` to
    before ``end`` are those of their detections, where these have none of it. ``sha256`` is of
    those events' payloads, in order."""

    kind: Literal["reembed"] = "reembed"
    space: Text
    dim: Annotated[int, Field(ge=1, le=MAX_DIMENSION)]
    first: Annotated[Offset, INT64]
    end: Annotated[Offset, INT64]
    detections: Annotated[int, Field(ge=1)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Undo(_Command):
    """The command ``undone`` has no effect. Undoing an undo restores the command."""

    kind: Literal["undo"] = "undo"
    undone: Text


Command: TypeAlias = (
    NamePlace
    | KeepApart
    | UndoMerge
    | Join
    | SameObject
    | DifferentObjects
    | DropObject
    | DropDetection
    | ForgetRun
    | ForgetKeyframes
    | CorrectPoses
    | JoinFrames
    | Relabel
    | UseSettings
    | Reembed
    | Undo
)
KINDS: tuple[str, ...] = tuple(c.model_fields["kind"].default for c in Command.__args__)
COMMAND: TypeAdapter[Command] = TypeAdapter(Annotated[Command, Field(discriminator="kind")])
_validate_json: Callable[[bytes], Command] = COMMAND.validator.validate_json
"""``COMMAND.validate_json`` without its Python wrapper."""


class InvalidCommand(ValueError):
    """A payload that is no command; the message names the field, its value and the rule."""


class UnknownKind(InvalidCommand):
    """A command of a kind that is not among `KINDS`."""

    def __init__(self, kind: str) -> None:
        shown = kind if len(kind) <= _MOST_SHOWN else f"{kind[:_MOST_SHOWN]}…"
        super().__init__(f"it is a command of kind {shown!r}, which this version does not know")


def parse_command(payload: bytes) -> Command:
    """A command from its JSON. Raises InvalidCommand."""
    if len(payload) > MAX_COMMAND_BYTES:
        raise InvalidCommand(f"it has {len(payload):,} bytes, more than {MAX_COMMAND_BYTES:,}")
    if len(payload) > _UNCOUNTED_BYTES:
        _check_cost(payload)
    try:
        return _validate_json(payload)
    except ValidationError as error:
        first = error.errors()[0]
        if first["type"] == "union_tag_invalid":
            raise UnknownKind(str(first["ctx"]["tag"])) from None
        field = ".".join(map(str, first["loc"])) or "the command"
        raise InvalidCommand(f"{field}: {describe_error(first)}") from None


def _check_cost(payload: bytes) -> None:
    """Raise InvalidCommand for JSON that would take much time or memory to validate.

    Pydantic makes an error for every unknown field, which takes 30 microseconds and 5 kB each.
    """
    values = sum(map(payload.count, (b",", b"[", b"{")))
    if values > MAX_JSON_VALUES:
        raise InvalidCommand(
            f"it has {values:,} commas and opening brackets, more than {MAX_JSON_VALUES:,}"
        )
    try:
        rest = [from_json(payload)]
    except ValueError as error:
        raise InvalidCommand(f"the command: {error}") from None
    while rest:
        value = rest.pop()
        if isinstance(value, dict):
            if len(value) > MAX_JSON_FIELDS:
                raise InvalidCommand(f"an object in it has more than {MAX_JSON_FIELDS} fields")
            rest.extend(value.values())
        elif isinstance(value, list):
            rest.extend(value)


def encode_command(command: Command) -> bytes:
    """A command's JSON, as it is logged."""
    return command.model_dump_json(exclude_none=True).encode()
