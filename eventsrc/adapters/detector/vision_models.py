"""What the two models do with pictures: find objects (an ONNX detector with its head and labels),
and encode their crops (an ONNX image tower: CLIP, SigLIP or the like).

A JSON file beside the encoder's model, of the same name, describes how pictures are prepared for
it; docs/detector.md has it for common models:

    {"model": "ViT-B-32/laion2b_s34b_b79k", "size": 224, "resize": "crop",
     "mean": [0.4815, 0.4578, 0.4082], "std": [0.2686, 0.2613, 0.2758]}
"""

import ast
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.base.user_files import read_label_file
from eventsrc.envelope.model import MAX_DIMENSION, Text

from .heads import HEADS, Boxes, HeadError, suppress
from .onnx_model import Description, ModelError, OnnxModel, read_description
from .picture import Pixels
from .vision import Canvas, Fit, Scaling, fitted, planes

CONFIDENCE: Final = 0.25
OVERLAP: Final = 0.5
MOST: Final = 100
SIZE: Final = 640
_MAX_SIDE: Final = 4_096
_MAX_LABELS: Final = 100_000
_SMALLEST_PX: Final = 1.0
_LABEL: Final = TypeAdapter(Text)

COCO: Final = (
    "person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant"
    " stop_sign parking_meter bench bird cat dog horse sheep cow elephant bear zebra giraffe"
    " backpack umbrella handbag tie suitcase frisbee skis snowboard sports_ball kite baseball_bat"
    " baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup fork knife spoon bowl"
    " banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair couch"
    " potted_plant bed dining_table toilet tv laptop mouse remote keyboard cell_phone microwave"
    " oven toaster sink refrigerator book clock vase scissors teddy_bear hair_drier toothbrush"
)
"""The classes of COCO in their usual order, with _ for a space."""


class FinderOptions(NamedTuple):
    """The ``head`` of the model, the least ``confidence`` of a detection, the greatest ``overlap``
    (intersection over union) of two boxes of a class, and the most detections in a picture.
    ``size`` is the side of the input in pixels if the model does not fix it."""

    head: str = "yolov8"
    confidence: float = CONFIDENCE
    overlap: float = OVERLAP
    most: int = MOST
    size: int = SIZE


class Found(NamedTuple):
    """The detections in one picture, best first, and counts of the boxes left out.

    ``not_finite`` boxes have NaN or infinite numbers, ``too_small`` ones are less than a pixel wide
    or high within the picture, ``cut`` ones are beyond the most that a picture may have.
    """

    boxes: Boxes
    scores: list[float]
    labels: list[str]
    not_finite: int
    too_small: int
    cut: int

    def without(self, classes: Collection[str]) -> "Found":
        """Without the detections of these classes."""
        left = [i for i, label in enumerate(self.labels) if label not in classes]
        if len(left) == len(self.labels):
            return self
        scores, labels = [self.scores[i] for i in left], [self.labels[i] for i in left]
        return self._replace(boxes=self.boxes[left], scores=scores, labels=labels)


class Finder:
    """An opened detector. The constructor runs it on a grey picture, and raises ModelError if its
    output does not fit head or labels, MisuseError for wrong options."""

    def __init__(
        self, model: OnnxModel, labels: Sequence[str] | None, options: FinderOptions
    ) -> None:
        if options.head not in HEADS:
            raise MisuseError(f"--head {options.head}: choose one of {', '.join(HEADS)}")
        self._model, self._options = model, options
        self._head = HEADS[options.head]
        self._output = model.output("output0", "output")
        self.size = model.size or (options.size, options.size)
        if max(self.size) > _MAX_SIDE:
            raise ModelError(
                f"{model.path}: its input is {model.input.text}, a side over {_MAX_SIDE}"
            )
        if model.batch not in (None, 1):
            raise ModelError(
                f"{model.path}: it takes {model.batch} pictures at once; export it for one"
            )
        self.labels = tuple(labels) if labels is not None else _labels_in(model)
        head = self._head
        self._scaling = Scaling.of(rgb=head.rgb, scale=head.scale, mean=head.mean, std=head.std)
        self._input = np.empty((1, 3, self.size[1], self.size[0]), np.float32)
        self._canvas = Canvas(self.size, centred=self._head.centred)
        self.find(np.full((self.size[1], self.size[0], 3), 114, np.uint8))

    def find(self, pixels: Pixels) -> Found:
        """The detections in a picture, in its pixels. Raises ModelError."""
        laid, letterbox = self._canvas.lay(pixels)
        head, options = self._head, self._options
        answer = self._model.run(planes([laid], self._scaling, self._input), self._output)
        try:
            read = head.decode(answer, self.size, len(self.labels), options.confidence)
        except HeadError as error:
            raise ModelError(f"{self._model.path}: {error}{self._advice(answer.shape)}") from None
        boxes = letterbox.to_picture(read.boxes)
        large = (boxes[:, 2:] - boxes[:, :2]).min(axis=1, initial=np.inf) >= _SMALLEST_PX
        boxes, scores, classes = boxes[large], read.scores[large], read.classes[large]
        overlap = options.overlap if head.suppressed else 1.0
        kept = suppress(boxes, scores, classes, max_overlap=overlap, most=options.most)
        return Found(
            boxes[kept.indices],
            scores[kept.indices].tolist(),
            [self.labels[index] for index in classes[kept.indices].tolist()],
            read.not_finite,
            int(len(large) - np.count_nonzero(large)),
            kept.cut,
        )

    def _advice(self, shape: tuple[int, ...]) -> str:
        """What to try for an output of this shape, as the end of a message."""
        count = len(self.labels)
        fits = {
            "yolov8": len(shape) == 3 and shape[1] == 4 + count,
            "yolov10": len(shape) == 3 and shape[2] == 6,
            "yolox": len(shape) == 3 and shape[2] == 5 + count,
            "nanodet": len(shape) == 3 and shape[2] == 32 + count,
        }
        others = [name for name, fit in fits.items() if fit and name != self._options.head]
        if others:
            return f"; try --head {others[0]}"
        return f"; check --head ({', '.join(HEADS)}) and --labels ({count} now)"


def read_labels(given: str) -> tuple[str, ...]:
    """The classes of ``coco``, or of a file: a line each, or a JSON list. Raises MisuseError."""
    if given == "coco":
        return tuple(name.replace("_", " ") for name in COCO.split())
    names = read_label_file(Path(given), "give a file, or coco")
    return _checked(names, f"--labels {given}")


def _labels_in(model: OnnxModel) -> tuple[str, ...]:
    """The labels that Ultralytics writes into its exports: ``{0: 'person', 1: …}``."""
    text = model.metadata.get("names")
    if text is None:
        raise MisuseError(
            f"{model.path}: it does not name its classes; give --labels FILE with a line for each,"
            " or --labels coco"
        )
    try:
        names = ast.literal_eval(text)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        names = None
    if isinstance(names, dict) and set(names) == set(range(len(names))):
        names = [names[index] for index in range(len(names))]
    return _checked(names, f"{model.path}: the classes in its metadata")


def _checked(names: object, place: str) -> tuple[str, ...]:
    if not isinstance(names, list) or not 0 < len(names) <= _MAX_LABELS:
        raise MisuseError(f"{place}: no list of classes; give --labels FILE with a line for each")
    for number, name in enumerate(names, start=1):
        try:
            _LABEL.validate_python(name, strict=True)
        except ValidationError:
            raise MisuseError(
                f"{place}: class {number} is {visible(repr(name))[:60]}, and a class is 1 to 256"
                " characters without control characters"
            ) from None
    return tuple(names)


BATCH: Final = 32
"""Crops in one batch, for a model that takes any number."""
_MAX_PIXELS: Final = 64_000_000
"""Of the crops of a batch: they take 12 bytes each."""
_Side = Annotated[int, Field(ge=1, le=2048)]
_Channel = Annotated[float, Field(ge=-10.0, le=10.0)]
_Spread = Annotated[float, Field(ge=1e-3, le=1000.0)]


class Preparation(Description):
    """The content of the JSON file beside an encoder.

    ``size`` is width and height or the side of a square. From values of 0 to 1 ``mean`` is
    subtracted, and the result divided by ``std``, for red, green and blue. ``resize`` uses the
    middle of a crop (``crop``), all of it stretched, or all of it with black around (``pad``).
    """

    EXAMPLE = '{"model": "NAME", "size": 224, "mean": [0.5, 0.5, 0.5], "std": [0.5, 0.5, 0.5]}'

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


def read_preparation(model: Path) -> Preparation:
    """The preparation of a model. Raises MisuseError."""
    return read_description(model, Preparation)


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
