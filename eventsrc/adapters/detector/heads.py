"""Heads: how families of object detectors take pictures, decoders of their outputs, and non-maximum
suppression of boxes that show the same thing.

A decoder turns the output into candidates: the best class of each anchor whose score reaches the
threshold. Boxes are in pixels of the input.

    yolov8    1 × (4 + classes) × N      centre, size; YOLOv8, v9, v11, v12 as Ultralytics exports
    yolov10   1 × N × 6                  corners, score, class; without suppression
    yolox     1 × N × (5 + classes)      offsets in cells of 8, 16 and 32 pixels; objectness
    nanodet   1 × N × (classes + 32)     NanoDet-Plus: distances as distributions of eight bins
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .onnx_model import Array, shape_text

Boxes = NDArray[np.float64]
"""Pixels x0, y0, x1 and y1 of each box, shape (n, 4)."""


class Candidates(NamedTuple):
    """Boxes decoded from a model's answer, in pixels of its input, with their best class.

    ``not_finite`` counts the boxes left out because a number of theirs is NaN or infinite.
    """

    boxes: Boxes
    scores: NDArray[np.float64]
    classes: NDArray[np.intp]
    not_finite: int


class Kept(NamedTuple):
    """Indices of the boxes that are kept, best first, and the number of boxes cut by the limit."""

    indices: list[int]
    cut: int


def suppress(
    boxes: Boxes,
    scores: NDArray[np.float64],
    classes: NDArray[np.intp],
    *,
    max_overlap: float,
    most: int,
) -> Kept:
    """Non-maximum suppression: keep boxes in order of falling score, and drop each whose
    intersection over union with a kept one of its class is over ``max_overlap``.

    Of equal scores the earlier comes first. At most ``most`` boxes are kept.
    """
    order = np.argsort(-scores, kind="stable")
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    kept: list[int] = []
    while len(order) and len(kept) < most:
        best, rest = int(order[0]), order[1:]
        kept.append(best)
        near = _overlaps(boxes[best], areas[best], boxes[rest], areas[rest]) > max_overlap
        order = rest[~(near & (classes[rest] == classes[best]))]
    return Kept(kept, len(order))


def _overlaps(
    box: NDArray[np.float64],
    area: np.float64,
    others: Boxes,
    areas: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The intersection over union of one box with others; 0 where both are empty."""
    low = np.maximum(box[:2], others[:, :2])
    high = np.minimum(box[2:], others[:, 2:])
    sides = np.maximum(high - low, 0.0)
    shared = sides[:, 0] * sides[:, 1]
    union = area + areas - shared
    found: NDArray[np.float64] = np.divide(
        shared, union, out=np.zeros_like(shared), where=union > 0.0
    )
    return found


Size: TypeAlias = tuple[int, int]
"""Width and height of a model's input."""
_SURE: Final = 1.001
"""Scores are probabilities; half precision may round them up."""
_BINS: Final = 8
_LARGEST_EXPONENT: Final = 20.0
"""Bound of a box's side in cells, beyond the width of any picture."""


class HeadError(ValueError):
    """A model's output does not fit the head; the message says what it is instead."""


Decode: TypeAlias = Callable[[Array, Size, int, float], Candidates]


class Head(NamedTuple):
    """A decoder, and how pictures are prepared: the order of colours, (value * scale - mean) / std,
    and whether the picture is in the middle of the input or at its top left. ``suppressed`` says
    whether the boxes need non-maximum suppression, because the model does none."""

    decode: Decode
    rgb: bool
    scale: float
    centred: bool
    suppressed: bool = True
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)


def _decode_yolov8(answer: Array, _size: Size, classes: int, least: float) -> Candidates:
    _check_shape(answer, (1, 4 + classes, None), f"yolov8 of {classes} classes")
    rows = answer[0]
    usable = _finite_columns(rows)
    scores = rows[4:]
    best = scores.max(axis=0)
    chosen = _chosen(best, usable, least)
    x, y, w, h = rows[:4, chosen].astype(np.float64)
    boxes = np.stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2], axis=1)
    return _candidates(boxes, best, scores[:, chosen].argmax(axis=0), chosen, usable)


def _decode_yolov10(answer: Array, _size: Size, classes: int, least: float) -> Candidates:
    _check_shape(answer, (1, None, 6), "yolov10")
    rows = answer[0].T
    usable = _finite_columns(rows)
    chosen = _chosen(rows[4], usable, least)
    named = rows[5, chosen]
    if len(named) and not (named.min() >= 0 and named.max() < classes):
        raise HeadError(f"it names class {named.max():g} of {classes}; check --labels")
    boxes = rows[:4, chosen].T.astype(np.float64)
    return _candidates(boxes, rows[4], named.astype(np.intp), chosen, usable)


def _decode_yolox(answer: Array, size: Size, classes: int, least: float) -> Candidates:
    cells = _cells(size, (8, 16, 32), ceiled=False)
    _check_shape(answer, (1, len(cells), 5 + classes), f"yolox of {classes} classes")
    rows = answer[0]
    usable = _finite_columns(rows.T)
    best = rows[:, 4] * rows[:, 5:].max(axis=1)
    chosen = _chosen(best, usable, least)
    found = rows[chosen]
    at, stride = cells[chosen, :2], cells[chosen, 2:]
    centre = (found[:, :2] + at) * stride
    half = np.exp(np.minimum(found[:, 2:4].astype(np.float64), _LARGEST_EXPONENT)) * stride / 2
    boxes = np.concatenate([centre - half, centre + half], axis=1)
    return _candidates(boxes, best, found[:, 5:].argmax(axis=1), chosen, usable)


def _decode_nanodet(answer: Array, size: Size, classes: int, least: float) -> Candidates:
    cells = _cells(size, (8, 16, 32, 64), ceiled=True)
    _check_shape(answer, (1, len(cells), classes + 4 * _BINS), f"nanodet of {classes} classes")
    rows = answer[0]
    usable = _finite_columns(rows.T)
    best = rows[:, :classes].max(axis=1)
    chosen = _chosen(best, usable, least)
    found = rows[chosen]
    bins = found[:, classes:].astype(np.float64).reshape(-1, 4, _BINS)
    weights = np.exp(bins - bins.max(axis=2, keepdims=True))
    distance = (weights @ np.arange(_BINS)) / weights.sum(axis=2) * cells[chosen, 2:]
    centre = cells[chosen, :2] * cells[chosen, 2:]
    boxes = np.concatenate([centre - distance[:, :2], centre + distance[:, 2:]], axis=1)
    return _candidates(boxes, best, found[:, :classes].argmax(axis=1), chosen, usable)


_BYTE: Final = 1 / 255

HEADS: Final[Mapping[str, Head]] = {
    "yolov8": Head(_decode_yolov8, rgb=True, scale=_BYTE, centred=True),
    "yolov10": Head(_decode_yolov10, rgb=True, scale=_BYTE, centred=True, suppressed=False),
    "yolox": Head(_decode_yolox, rgb=False, scale=1.0, centred=False),
    "nanodet": Head(
        _decode_nanodet,
        rgb=False,
        scale=1.0,
        centred=True,
        mean=(103.53, 116.28, 123.675),
        std=(57.375, 57.12, 58.395),
    ),
}


def _check_shape(answer: Array, shape: Sequence[int | None], name: str) -> None:
    """Raise HeadError unless ``answer`` has the ``shape``, in which None is any size."""
    fits = len(answer.shape) == len(shape) and all(
        wanted in (None, size) for size, wanted in zip(answer.shape, shape, strict=True)
    )
    if not fits:
        raise HeadError(
            f"it answers {shape_text(answer.shape)}, and {name} is "
            f"{shape_text(tuple(shape)).replace('?', 'N')}"
        )


def _finite_columns(rows: Array) -> NDArray[np.bool_] | None:
    """Which anchors (columns) of ``rows``, shape (values, anchors), have only finite numbers; None
    if all have."""
    if math.isfinite(float(rows.sum(dtype=np.float64))):
        return None
    usable: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(rows), axis=0)
    return None if usable.all() else usable


def _chosen(best: NDArray[Any], usable: NDArray[np.bool_] | None, least: float) -> NDArray[np.intp]:
    """The anchors that reach the threshold."""
    with np.errstate(invalid="ignore"):
        reached = best >= least
    if usable is not None:
        reached &= usable
    return np.flatnonzero(reached)


def _candidates(
    boxes: Boxes,
    best: NDArray[Any],
    classes: NDArray[np.intp],
    chosen: NDArray[np.intp],
    usable: NDArray[np.bool_] | None,
) -> Candidates:
    scores = best[chosen].astype(np.float64)
    if len(scores) and scores.max() > _SURE:
        raise HeadError(
            f"it gives a score of {scores.max():.4g}, and scores are probabilities from 0 to 1; "
            "export it with its sigmoid, or choose another --head"
        )
    not_finite = 0 if usable is None else int(np.count_nonzero(~usable))
    return Candidates(boxes, np.minimum(scores, 1.0), classes, not_finite)


def _cells(size: Size, strides: Sequence[int], *, ceiled: bool) -> NDArray[np.float64]:
    """Column, row and stride of every cell: rows of cells from the top, the smallest stride
    first."""
    parts = []
    for stride in strides:
        columns, rows = (math.ceil(s / stride) if ceiled else s // stride for s in size)
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        parts.append(np.stack([x, y, np.full_like(x, stride)], axis=-1).reshape(-1, 3))
    return np.concatenate(parts).astype(np.float64)
