"""Questions: the object crops a lost robot sees, read from JSON and checked.

A question is an envelope, a JSON list of detections, or ``{"crops": [...]}``. Each crop needs an
``embedding``, base64 of little-endian float32 as in an envelope, or a JSON list of numbers;
``class``, ``bbox``, ``det_id`` and ``embedding_model`` are optional. Crops without an embedding are
left out, because nothing can be searched with them. The pose in an envelope is *not* read: it is
what is being asked.

All crops are taken to come from one picture: their boxes say in which direction each lies.
"""

import binascii
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from eventsrc.envelope import MAX_DIMENSION, Text, describe_error
from eventsrc.text import counted
from projections.errors import QuestionError
from projections.exact import quantise, to_float32

MAX_CROPS: Final = 32
"""More crops than this are refused: each one costs a search."""
MAX_MARKS: Final = 20_000
"""More of ``[``, ``{`` and ``:`` than this are refused before the JSON is parsed. Empty lists and
objects cost most per byte; a question of 32 crops holds about 300 of these characters."""
_MAX_DESCRIBED: Final = 80

Vector = NDArray[np.float32]
Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """One crop: a unit vector, float32 of shape (dim,), and what else is known about it.

    ``vector`` is None when only the class is known; ``is_text`` says that it is the embedding of a
    text. ``bbox`` is x_min, y_min, x_max, y_max in pixels of the whole picture, None when unknown.
    """

    vector: Vector | None
    bbox: Box | None = None
    class_name: str | None = None
    det_id: str | None = None
    model: str | None = None
    is_text: bool = False

    @property
    def sort_key(self) -> tuple[bytes, Box, str, str]:
        """Puts crops into one order, whatever order they came in."""
        look = b"" if self.vector is None else self.vector.tobytes()
        box = self.bbox or (0.0, 0.0, 0.0, 0.0)
        return look, box, self.det_id or "", self.class_name or ""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The crops of one picture, and how the robot moved since the view before: metres ahead and to
    the left, and radians to the left, in its frame there; all 0 in the first view."""

    dx: float
    dy: float
    dyaw: float
    crops: tuple[Crop, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """Views of a robot one after the other; the answer is where it is at the last one."""

    views: tuple[View, ...]

    @property
    def crops(self) -> tuple[Crop, ...]:
        """The crops of all views, in order."""
        return tuple(crop for view in self.views for crop in view.crops)

    @classmethod
    def of(cls, crops: Sequence[Crop]) -> "Question":
        """The question of one picture."""
        return cls((View(0.0, 0.0, 0.0, tuple(crops)),))


# A list ends at its first wrong item: pydantic would collect an error of 2 kB for each of them.
_Numbers = Annotated[list[float], Field(max_length=MAX_DIMENSION, fail_fast=True)]
_Pixels = Annotated[list[float], Field(min_length=4, max_length=4, fail_fast=True)]


class _CropModel(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    embedding: str | _Numbers | None = None
    embedding_dim: Annotated[int, Field(ge=1, le=MAX_DIMENSION)] | None = None
    embedding_model: Text | None = None
    class_name: Text | None = Field(default=None, alias="class")
    bbox: _Pixels | None = None
    det_id: Text | None = None


_CROPS: TypeAdapter[list[_CropModel]] = TypeAdapter(
    Annotated[list[_CropModel], Field(fail_fast=True)]
)


def parse_question(payload: bytes) -> tuple[Crop, ...]:
    """Read a question. Raises QuestionError that names what is wrong and what to send instead."""
    return read_crops(parse_json(payload))


def parse_json(payload: bytes) -> Any:
    """The JSON document of a question. Raises QuestionError when it is none or too complex."""
    marks = sum(map(payload.count, (b"[", b"{", b":")))
    if marks > MAX_MARKS:
        raise QuestionError(
            f"the question is not a list of crops: it has {marks} brackets and colons, more than"
            f" {MAX_MARKS}; send at most {MAX_CROPS} crops"
        )
    try:
        return json.loads(payload)
    except json.JSONDecodeError as error:
        if error.msg == "Extra data":
            raise QuestionError(
                f"more comes behind the question, in line {error.lineno}; send one JSON document,"
                " such as one line of a file of envelopes"
            ) from None
        raise QuestionError(f"the question is not JSON: {error}") from None
    except (ValueError, RecursionError) as error:
        raise QuestionError(f"the question is not JSON: {error}") from None


def read_crops(document: Any) -> tuple[Crop, ...]:
    """The crops of a parsed question that have an embedding; at least one, of one dimension."""
    models = _validated(_crop_list(document))
    crops = [_crop(index, m) for index, m in enumerate(models) if m.embedding is not None]
    if not models:
        raise QuestionError("the question has no crops; send at least one, with its embedding")
    if not crops:
        count = counted(len(models), "crop")
        raise QuestionError(f"the question has {count} and no embedding; send at least one")
    _check_one_space(crops)
    return tuple(crops)


def _crop_list(document: Any) -> list[Any]:
    if isinstance(document, dict):
        for key in ("detections", "crops"):
            if isinstance(document.get(key), list):
                document = document[key]
                break
    if not isinstance(document, list):
        raise QuestionError(
            "the question is neither an envelope, nor a list of detections, nor an object with"
            ' "crops"; send one of these'
        )
    if len(document) > MAX_CROPS:
        raise QuestionError(
            f"the question has {len(document)} crops, more than {MAX_CROPS}; send the best ones"
        )
    return document


def _validated(items: list[Any]) -> list[_CropModel]:
    try:
        return _CROPS.validate_python(items)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        # Of the two forms of an embedding the list is named last, and says more.
        first = next((e for e in errors if e["loc"][-1] != "str"), errors[0])
        place = ".".join(str(p) for p in first["loc"] if not str(p).startswith("list["))
        what = (
            "should be a JSON object"
            if first["type"] == "model_type"
            else describe_error(first).lower()
        )
        raise QuestionError(f"crops.{place}: {what}") from None


def _crop(index: int, model: _CropModel) -> Crop:
    raw = _floats(index, model)
    if len(raw) > MAX_DIMENSION:
        raise QuestionError(
            f"crops.{index}.embedding: holds {len(raw)} numbers, more than {MAX_DIMENSION}"
        )
    if model.embedding_dim is not None and len(raw) != model.embedding_dim:
        raise QuestionError(
            f"crops.{index}.embedding: holds {counted(len(raw), 'number')}, embedding_dim says"
            f" {model.embedding_dim}"
        )
    if not np.isfinite(raw).all() or not raw.any():
        raise QuestionError(f"crops.{index}.embedding: holds NaN or infinity, or only zeros")
    box = None if model.bbox is None else (model.bbox[0], model.bbox[1], *model.bbox[2:])
    return Crop(
        to_float32(quantise(raw)),
        box,  # type: ignore[arg-type]  # four numbers: the model has checked it
        model.class_name,
        model.det_id,
        model.embedding_model,
    )


def _floats(index: int, model: _CropModel) -> Vector:
    given = model.embedding
    if isinstance(given, str):
        try:
            raw = binascii.a2b_base64(given, strict_mode=True)
        except (binascii.Error, ValueError) as error:
            raise QuestionError(f"crops.{index}.embedding: not base64: {error}") from None
        if not raw or len(raw) % 4:
            raise QuestionError(
                f"crops.{index}.embedding: {counted(len(raw), 'byte')}, so no row of 4-byte floats"
            )
        return np.frombuffer(raw, dtype="<f4")
    if not given:
        raise QuestionError(f"crops.{index}.embedding: is empty")
    with np.errstate(over="ignore"):  # an overflow becomes infinity and is refused as such
        return np.asarray(given, dtype=np.float64).astype(np.float32)


def _check_one_space(crops: Sequence[Crop]) -> None:
    dims = {len(crop.vector) for crop in crops if crop.vector is not None}
    models = {crop.model for crop in crops} - {None}
    if len(dims) > 1 or len(models) > 1:
        what = sorted(map(str, dims if len(dims) > 1 else models))
        raise QuestionError(
            f"the question mixes embedding spaces ({', '.join(what)}); send crops of one model"
        )


def describe_value(value: Any) -> str:
    """A value of a question for an error message: escaped, and at most 80 characters."""
    if isinstance(value, list | dict):
        return f"a {'list' if isinstance(value, list) else 'JSON object'}"
    text = repr(value[:_MAX_DESCRIBED] if isinstance(value, str) else value)
    return text if len(text) <= _MAX_DESCRIBED else f"{text[:_MAX_DESCRIBED]}…"
