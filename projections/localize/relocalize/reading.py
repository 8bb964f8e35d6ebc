"""Questions read from JSON and checked.

A question is an envelope, a JSON list of detections, ``{"crops": [...]}``, or several pictures,
``{"views": [{"dx", "dy", "dyaw", "crops": [...]}, ...]}``, where a view's movement is that since
the view before, in metres ahead and to the left and radians to the left; that of the first view is
read only where questions are tracked. A crop has an ``embedding``, base64 of little-endian float32
as in an envelope, or a JSON list of numbers; or else a ``class``, and then things of that class are
meant. ``"text": true`` marks the embedding of a text. ``class``, ``bbox``, ``det_id``
and ``embedding_model`` are optional, and so is the question's ``camera``, as in an envelope. Crops
with neither embedding nor class are left out, because nothing can be searched with them. The pose
in an envelope is *not* read: it is the answer that is sought.
"""

import binascii
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Final, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from eventsrc.base import user_files
from eventsrc.base.text import counted
from eventsrc.base.user_files import FileFault
from eventsrc.envelope.model import MAX_DIMENSION, Text, describe_error
from eventsrc.envelope.readers import EnvelopeCamera
from projections.fold.exact import quantise, to_float32
from projections.fold.map_errors import QuestionError
from projections.fold.settings import CameraConstants

from .question import (
    MAX_CROPS,
    MAX_VIEWS,
    STILL,
    Movement,
    Question,
    QuestionCrop,
    QuestionView,
    Vector,
)

MAX_MARKS: Final = 20_000
"""More of ``[``, ``{`` and ``:`` than this are refused before the JSON is parsed. Empty lists and
objects cost most per byte; a question of 32 crops holds about 300 of these characters."""
MAX_MOVED_M: Final = 1_000.0
"""Between two views."""
MAX_TURNED_RAD: Final = 1_000.0

# A list ends at its first wrong item: pydantic would collect an error of 2 kB for each of them.
_Numbers = Annotated[list[float], Field(max_length=MAX_DIMENSION, fail_fast=True)]
_Pixels = Annotated[list[float], Field(min_length=4, max_length=4, fail_fast=True)]


class CropModel(BaseModel):
    """The JSON form of a crop."""

    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    embedding: str | _Numbers | None = None
    embedding_dim: Annotated[int, Field(ge=1, le=MAX_DIMENSION)] | None = None
    embedding_model: Text | None = None
    text: bool = False
    class_name: Text | None = Field(default=None, alias="class")
    bbox: _Pixels | None = None
    det_id: Text | None = None


_CROPS: TypeAdapter[list[CropModel]] = TypeAdapter(
    Annotated[list[CropModel], Field(fail_fast=True)]
)


class MovementModel(BaseModel):
    """The JSON form of the robot's movement since the view before."""

    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    dx: Annotated[float, Field(ge=-MAX_MOVED_M, le=MAX_MOVED_M)]
    dy: Annotated[float, Field(ge=-MAX_MOVED_M, le=MAX_MOVED_M)]
    dyaw: Annotated[float, Field(ge=-MAX_TURNED_RAD, le=MAX_TURNED_RAD)]


MAX_QUESTION_BYTES: Final = 16 * 1024 * 1024
"""Bound of a file with a question."""


def parse_question(payload: bytes) -> Question:
    """Read a question. Raises QuestionError that names what is wrong and what to send instead."""
    return read_question(parse_json(payload))


def parse_json(payload: bytes) -> Any:
    """The JSON document of a question. Raises QuestionError for a payload that is not JSON or too
    complex."""
    marks = sum(map(payload.count, (b"[", b"{", b":")))
    if marks > MAX_MARKS:
        raise QuestionError(
            f"the question is not a list of crops: it has {marks} brackets and colons, more than"
            f" {MAX_MARKS}; send at most {MAX_CROPS} crops"
        )
    try:
        return user_files.parse_json(payload)
    except FileFault as fault:
        cause = fault.__cause__
        if isinstance(cause, json.JSONDecodeError) and cause.msg == "Extra data":
            raise QuestionError(
                f"there is more after the question, in line {cause.lineno}; send one JSON document,"
                " such as one line of a file of envelopes"
            ) from None
        raise QuestionError(f"the question is not JSON: {fault}") from None


def read_question(document: Any) -> Question:
    """A parsed question: at least one crop, and all embeddings of one space."""
    if isinstance(document, dict) and "views" in document:
        beside = [key for key in ("crops", "detections") if document.get(key) is not None]
        if beside:
            raise QuestionError(
                f"the question has views and {beside[0]}; send each crop in the view that shows it"
            )
        question = _read_views(document["views"], document.get("camera"))
    else:
        question = Question.of(_read_crops(document, "crops"))
    _check_crops(question.crops)
    if isinstance(document, dict) and document.get("camera") is not None:
        given = _checked(EnvelopeCamera, document["camera"], "camera")
        camera = CameraConstants.model_validate(given, from_attributes=True)
        return replace(question, camera=camera)
    return question


_M = TypeVar("_M", bound=BaseModel)


def _checked(model: type[_M], document: Any, path: str, if_missing: str = "") -> _M:
    """A part of a document, which is at ``path`` of it. ``if_missing`` is said of a key that is not
    there."""
    try:
        return model.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in (path, *first["loc"]) if part)
        missing = if_missing if first["type"] == "missing" else ""
        raise QuestionError(f"{key}: {missing or describe_error(first).lower()}") from None


def _read_views(items: Any, camera: Any) -> Question:
    """``camera`` is the question's, None where it has none."""
    if not isinstance(items, list) or not items:
        raise QuestionError('views: send a list of views, such as {"crops": [...]}')
    if len(items) > MAX_VIEWS:
        raise QuestionError(
            f"the question has {len(items)} views, more than {MAX_VIEWS}; send the latest ones"
        )
    views, crops = [], 0
    for index, item in enumerate(items):
        name = f"views.{index}"
        if not isinstance(item, dict):
            raise QuestionError(f"{name}: should be a JSON object")
        if item.get("camera") not in (None, camera):
            raise QuestionError(
                f"{name}.camera: the views of a question have one camera; give it beside views"
            )
        moved = _movement(item, name, "view") if index else STILL
        view = QuestionView(*moved, _read_crops(item, f"{name}.crops"))
        crops += len(view.crops)
        if crops > MAX_CROPS:
            raise QuestionError(
                f"the question has more than {MAX_CROPS} crops in all its views; send the best ones"
            )
        views.append(view)
    return Question(tuple(views))


def read_moved(document: Any) -> Movement:
    """How a robot whose questions are tracked has moved since the one before: ``dx``, ``dy`` and
    ``dyaw`` of the question, or of its first view; no movement if there is none of them."""
    if not isinstance(document, dict):
        return STILL
    views = document.get("views")
    name, found = "", document
    if isinstance(views, list) and views and isinstance(views[0], dict):
        name, found = "views.0", views[0]
    return _movement(found, name, "question") if found.keys() & {"dx", "dy", "dyaw"} else STILL


def _movement(document: dict[str, Any], name: str, since: str) -> Movement:
    """A movement; ``since`` is ``view`` or ``question``, for messages."""
    missing = f"is missing; give the metres and radians moved since the {since} before"
    moved = _checked(MovementModel, document, name, missing)
    return moved.dx, moved.dy, moved.dyaw


def _read_crops(document: Any, name: str) -> tuple[QuestionCrop, ...]:
    """The crops that have an embedding or a class; ``name`` is their path in the document, for
    messages."""
    try:
        items = _crop_list(document)
    except QuestionError as error:
        view = name.removesuffix("crops").removesuffix(".")
        raise QuestionError(f"{view}: {error}" if view else str(error)) from None
    return tuple(
        _crop(f"{name}.{index}", model)
        for index, model in enumerate(_validated(items, name))
        if model.embedding is not None or model.class_name is not None
    )


def _check_crops(crops: Sequence[QuestionCrop]) -> None:
    if not crops:
        raise QuestionError(
            "the question has no crops with an embedding or a class; send at least one"
        )
    dims = {len(crop.vector) for crop in crops if crop.vector is not None}
    models = {crop.model for crop in crops} - {None}
    if len(dims) > 1 or len(models) > 1:
        what = sorted(map(str, dims if len(dims) > 1 else models))
        raise QuestionError(
            f"the question mixes embedding spaces ({', '.join(what)}); send crops of one model"
        )


def _crop_list(document: Any) -> list[Any]:
    if isinstance(document, dict):
        lists = (document.get(key) for key in ("detections", "crops"))
        document = next((each for each in lists if isinstance(each, list)), document)
    if not isinstance(document, list):
        raise QuestionError(
            "the question is neither an envelope, nor a list of detections, nor an object with"
            ' "crops" or "views"; send one of these'
        )
    if len(document) > MAX_CROPS:
        raise QuestionError(
            f"the question has {len(document)} crops, more than {MAX_CROPS}; send the best ones"
        )
    return document


def _validated(items: list[Any], name: str) -> list[CropModel]:
    try:
        return _CROPS.validate_python(items)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        # The error of an embedding as a list comes after that as a text, and has more details.
        first = next((e for e in errors if e["loc"][-1] != "str"), errors[0])
        place = ".".join(str(p) for p in first["loc"] if not str(p).startswith("list["))
        is_object = first["type"] != "model_type"
        what = describe_error(first).lower() if is_object else "should be a JSON object"
        raise QuestionError(f"{name}.{place}: {what}") from None


def _crop(name: str, model: CropModel) -> QuestionCrop:
    box = None if model.bbox is None else (model.bbox[0], model.bbox[1], *model.bbox[2:])
    vector = None if model.embedding is None else _unit_vector(name, model)
    return QuestionCrop(
        vector,
        box,  # type: ignore[arg-type]  # four numbers: the model has checked it
        model.class_name,
        model.det_id,
        model.embedding_model if vector is not None else None,
        model.text and vector is not None,
    )


def _unit_vector(name: str, model: CropModel) -> Vector:
    raw = _floats(name, model.embedding)
    if len(raw) > MAX_DIMENSION:
        raise QuestionError(
            f"{name}.embedding: holds {len(raw)} numbers, more than {MAX_DIMENSION}"
        )
    if model.embedding_dim is not None and len(raw) != model.embedding_dim:
        raise QuestionError(
            f"{name}.embedding: holds {counted(len(raw), 'number')}, embedding_dim says"
            f" {model.embedding_dim}"
        )
    if not np.isfinite(raw).all() or not raw.any():
        raise QuestionError(f"{name}.embedding: holds NaN or infinity, or only zeros")
    return to_float32(quantise(raw))


def _floats(name: str, given: str | list[float] | None) -> Vector:
    if isinstance(given, str):
        try:
            raw = binascii.a2b_base64(given, strict_mode=True)
        except (binascii.Error, ValueError) as error:
            raise QuestionError(f"{name}.embedding: not base64: {error}") from None
        if not raw or len(raw) % 4:
            raise QuestionError(
                f"{name}.embedding: {counted(len(raw), 'byte')}, so no row of 4-byte floats"
            )
        return np.frombuffer(raw, dtype="<f4")
    if not given:
        raise QuestionError(f"{name}.embedding: is empty")
    with np.errstate(over="ignore"):  # an overflow becomes infinity and is refused as such
        return np.asarray(given, dtype=np.float64).astype(np.float32)


_SEARCHABLE: Final = {
    "anyOf": [
        {"required": ["embedding"], "properties": {"embedding": {"type": ["string", "array"]}}},
        {"required": ["class"], "properties": {"class": {"type": "string"}}},
    ]
}
"""The schema of a crop with an embedding or a class."""
_EMBEDDING_TEXT: Final = {
    "type": "string",
    "contentEncoding": "base64",
    "pattern": "^(S{16})*(S{16}|S{11}=|S{6}==)$".replace("S", "[A-Za-z0-9+/]"),
    "description": "base64 of little-endian float32",
}


def question_schema(options: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The JSON schema of questions; ``options`` are properties that the answering side reads beside
    those of the question.

    It states all checks, except those that a schema cannot express: that embeddings are of the
    map's space and classes those of its Objects, and that `MAX_CROPS` counts the crops of all views
    together.
    """
    crops = _crops_schema() | {"minItems": 1, "contains": _SEARCHABLE}
    camera = EnvelopeCamera.model_json_schema()
    common = {"camera": {"anyOf": [camera, {"type": "null"}]}, **(options or {})}
    movement = MovementModel.model_json_schema()["properties"]
    moved = {
        key: {**value, "description": "Since the previous question; only read with a session."}
        for key, value in movement.items()
    }
    together = {key: [other for other in moved if other != key] for key in moved}
    one_picture = {"not": {"required": ["views"]}, "dependentRequired": together}
    not_list, null = {"not": {"type": "array"}}, {"type": "null"}

    def one(key: str, *rules: dict[str, Any]) -> dict[str, Any]:
        return {
            "type": "object",
            "properties": {key: crops, **moved, **common},
            "required": [key],
            "allOf": [one_picture, *rules],
        }

    return {
        "title": "Question",
        "anyOf": [
            one("crops", {"properties": {"detections": not_list}}),
            one("detections"),
            {
                "type": "object",
                "properties": {"views": _views_schema(movement, together), **common},
                "required": ["views"],
                "allOf": [{"properties": {"crops": null, "detections": null}}],
            },
            crops,
        ],
    }


def _crops_schema() -> dict[str, Any]:
    crop = CropModel.model_json_schema(by_alias=True)
    float32 = np.finfo(np.float32)
    largest, least = float(float32.max), float(float32.smallest_subnormal)
    numbers = {
        "type": "array",
        "items": {"type": "number", "minimum": -largest, "maximum": largest},
        "minItems": 1,
        "maxItems": MAX_DIMENSION,
        "contains": {"anyOf": [{"minimum": least}, {"maximum": -least}]},  # not only zeros
    }
    crop["properties"]["embedding"]["anyOf"] = [_EMBEDDING_TEXT, numbers, {"type": "null"}]
    crop |= {
        "title": "Crop",
        "description": "An object in a picture; it needs an embedding or a class.",
    }
    return {"type": "array", "items": crop, "maxItems": MAX_CROPS}


def _views_schema(movement: dict[str, Any], together: dict[str, Any]) -> dict[str, Any]:
    view = {
        "title": "View",
        "type": "object",
        "description": "The movement since the view before, and the crops of this view.",
        "properties": {**movement, "crops": _crops_schema()},
        "required": ["crops", *movement],
    }
    first = {
        **view,
        "title": "First view",
        "description": "The movement is that since the previous question, only read with a"
        " session.",
        "required": ["crops"],
        "dependentRequired": together,
    }
    return {
        "type": "array",
        "prefixItems": [first],
        "items": view,
        "minItems": 1,
        "maxItems": MAX_VIEWS,
        "contains": {"required": ["crops"], "properties": {"crops": {"contains": _SEARCHABLE}}},
    }
