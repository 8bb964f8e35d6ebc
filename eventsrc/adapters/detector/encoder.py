"""Encode crops with an ONNX image tower (CLIP, SigLIP or the like), and prepare pictures for it.

A JSON file beside the model, of the same name, describes the preparation; docs/detector.md has it
for common models:

    {"model": "ViT-B-32/laion2b_s34b_b79k", "size": 224, "resize": "crop",
     "mean": [0.4815, 0.4578, 0.4082], "std": [0.2686, 0.2613, 0.2758]}
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import FileFault, read_file
from eventsrc.envelope.model import MAX_DIMENSION, Text

from .onnx_model import ModelError, OnnxModel
from .picture import Pixels
from .vision import Fit, Scaling, fitted, planes

BATCH: Final = 32
_MAX_PIXELS: Final = 64_000_000
"""Of the crops of a batch: they take 12 bytes each."""
"""Crops in one batch, for a model that takes any number."""
_Side = Annotated[int, Field(ge=1, le=2048)]
_Channel = Annotated[float, Field(ge=-10.0, le=10.0)]
_Spread = Annotated[float, Field(ge=1e-3, le=1000.0)]


class Preparation(BaseModel):
    """The content of the JSON file beside a model.

    ``size`` is width and height or the side of a square. From values of 0 to 1 ``mean`` is
    subtracted, and the result divided by ``std``, for red, green and blue. ``resize`` uses the
    middle of a crop (``crop``), all of it stretched, or all of it with black around (``pad``).
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    model: Text
    size: _Side | Annotated[list[_Side], Field(min_length=2, max_length=2)]
    mean: Annotated[list[_Channel], Field(min_length=3, max_length=3)]
    std: Annotated[list[_Spread], Field(min_length=3, max_length=3)]
    resize: Fit = "crop"
    interpolation: Literal["bicubic", "bilinear"] = "bicubic"
    normalize: bool = True
    output: str | None = None

    @property
    def wide_and_high(self) -> tuple[int, int]:
        """Width and height."""
        if isinstance(self.size, int):
            return self.size, self.size
        return self.size[0], self.size[1]


_MAX_PREPARATION_BYTES: Final = 64 * 1024


def read_preparation(model: Path) -> Preparation:
    """The preparation of a model. Raises MisuseError."""
    path = model.with_suffix(".json")
    try:
        text = read_file(path, _MAX_PREPARATION_BYTES)
    except FileFault as fault:
        raise MisuseError(
            f"{path}: {fault}; this file describes the input of {model.name},"
            ' such as {"model": "NAME", "size": 224, "mean": [0.5, 0.5, 0.5], "std": [0.5, 0.5,'
            " 0.5]}; see docs/detector.md"
        ) from None
    try:
        return Preparation.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        raise MisuseError(f"{path}: {place}: {first['msg']}; see docs/detector.md") from None


class Encoder:
    """An opened image tower. The constructor runs it on a grey crop, and raises ModelError if the
    output is not one vector a crop."""

    def __init__(self, model: OnnxModel, preparation: Preparation) -> None:
        self._model, self._preparation = model, preparation
        wanted = (preparation.output,) if preparation.output else ()
        self._output = model.output(*wanted, "image_embeds", "image_features", "embedding")
        self._size = preparation.wide_and_high
        if model.size is not None and model.size != self._size:
            raise ModelError(
                f"{model.path}: its input is {model.input.text}, and the size in"
                f" {model.path.with_suffix('.json').name} is {self._size[0]} × {self._size[1]}"
            )
        pixels = self._size[0] * self._size[1]
        self._batch = model.batch or max(1, min(BATCH, _MAX_PIXELS // pixels))
        if self._batch * pixels > max(pixels, _MAX_PIXELS):
            raise ModelError(
                f"{model.path}: it takes {self._batch:,} crops of {pixels:,} pixels at once, more"
                f" than {_MAX_PIXELS:,} pixels; export it for fewer"
            )
        self._scaling = Scaling.of(
            rgb=True, scale=1 / 255, mean=preparation.mean, std=preparation.std
        )
        self.dimension = len(self._run([np.full((8, 8, 3), 114, np.uint8)])[0])

    @property
    def name(self) -> str:
        """The name of the embedding space."""
        return self._preparation.model

    def encode(self, crops: Sequence[Pixels]) -> list[NDArray[np.float32] | None]:
        """The vectors of crops, computed in batches; None where one is zero or not finite.

        Raises ModelError.
        """
        step = self._batch
        vectors: list[NDArray[np.float32] | None] = []
        for start in range(0, len(crops), step):
            rows = self._run(crops[start : start + step])
            vectors += [self._usable(row) for row in rows]
        return vectors

    def _run(self, crops: Sequence[Pixels]) -> NDArray[np.float32]:
        wanted = self._preparation
        cubic = wanted.interpolation == "bicubic"
        small = [fitted(crop, self._size, wanted.resize, cubic=cubic) for crop in crops]
        if self._model.batch is not None:  # a fixed number: repeat the last crop
            small += small[-1:] * (self._model.batch - len(small))
        answer = self._model.run(planes(small, self._scaling), self._output)
        if (
            answer.ndim != 2
            or len(answer) != len(small)
            or not 0 < answer.shape[1] <= MAX_DIMENSION
        ):
            shape = " × ".join(map(str, answer.shape))
            raise ModelError(
                f"{self._model.path}: output {self._output} is {shape} for {len(small)} crops; one"
                " vector for each is needed: export the pooled embedding"
            )
        return answer[: len(crops)].astype(np.float32, copy=False)

    def _usable(self, row: NDArray[np.float32]) -> NDArray[np.float32] | None:
        norm = float(np.linalg.norm(row.astype(np.float64)))
        if not np.isfinite(norm) or norm < 1e-12:
            return None
        return (row / norm).astype(np.float32) if self._preparation.normalize else row
