"""A question: the object crops a lost robot sees, read from JSON.

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
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from eventsrc.envelope import MAX_DIMENSION, Text, fault
from eventsrc.words import counted
from projections.errors import QuestionError
from projections.exact import quantise, to_float32

MAX_CROPS = 32
"""More crops than this are refused: each one costs a search."""

Vector = NDArray[np.float32]
Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """One crop: a unit vector, float32 of shape (dim,), and what else is known about it.

    ``bbox`` is x_min, y_min, x_max, y_max in pixels of the whole picture, None when unknown.
    """

    vector: Vector
    bbox: Box | None = None
    class_name: str | None = None
    det_id: str | None = None
    model: str | None = None

    @property
    def order(self) -> tuple[bytes, Box, str]:
        """A key that puts crops into one order whatever order they came in."""
        return self.vector.tobytes(), self.bbox or (0.0, 0.0, 0.0, 0.0), self.det_id or ""


class _CropModel(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    embedding: str | list[float] | None = None
    embedding_dim: Annotated[int, Field(ge=1, le=MAX_DIMENSION)] | None = None
    embedding_model: Text | None = None
    class_name: Text | None = Field(default=None, alias="class")
    bbox: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    det_id: Text | None = None


_CROPS: TypeAdapter[list[_CropModel]] = TypeAdapter(list[_CropModel])


def parse_question(payload: bytes | str) -> tuple[Crop, ...]:
    """Read a question. Raises QuestionError that names what is wrong and what to send instead."""
    try:
        document = json.loads(payload)
    except json.JSONDecodeError as error:
        if error.msg == "Extra data":
            raise QuestionError(
                f"more comes behind the question, in line {error.lineno}; send one JSON document,"
                " such as one line of a file of envelopes"
            ) from None
        raise QuestionError(f"the question is not JSON: {error}") from None
    except (ValueError, RecursionError) as error:
        raise QuestionError(f"the question is not JSON: {error}") from None
    return read_crops(document)


def read_crops(document: Any) -> tuple[Crop, ...]:
    """The crops of a parsed question that have an embedding; at least one, of one dimension."""
    models = _validated(_crop_list(document))
    crops = [_crop(index, m) for index, m in enumerate(models) if m.embedding is not None]
    if not models:
        raise QuestionError("the question has no crops; send at least one, with its embedding")
    if not crops:
        count = counted(len(models), "crop")
        raise QuestionError(f"the question has {count} and no embedding; send at least one")
    _same_space(crops)
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
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"] if not str(part).endswith("]"))
        raise QuestionError(f"crops.{place}: {fault(first).lower()}") from None


def _crop(index: int, model: _CropModel) -> Crop:
    raw = _floats(index, model)
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


def _same_space(crops: Sequence[Crop]) -> None:
    dims = {len(crop.vector) for crop in crops}
    models = {crop.model for crop in crops} - {None}
    if len(dims) > 1 or len(models) > 1:
        what = sorted(map(str, dims if len(dims) > 1 else models))
        raise QuestionError(
            f"the question mixes embedding spaces ({', '.join(what)}); send crops of one model"
        )
