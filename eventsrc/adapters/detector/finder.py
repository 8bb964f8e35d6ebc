"""Find objects in pictures: an ONNX detector, its head, its labels."""

import ast
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from pydantic import TypeAdapter, ValidationError

from eventsrc.base.errors import MisuseError
from eventsrc.base.label_files import read_label_file
from eventsrc.base.text import visible
from eventsrc.envelope.model import Text

from .boxes import Boxes, suppress
from .heads import HEADS, HeadError
from .onnx_model import ModelError, OnnxModel
from .picture import Pixels
from .vision import Canvas, Scaling, planes

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
