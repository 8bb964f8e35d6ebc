"""Boxes that a detector found, and non-maximum suppression of those that show the same thing."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
