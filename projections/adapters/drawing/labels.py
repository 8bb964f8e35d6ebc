"""Label placement: positions at which labels do not cover each other. No drawing here.

Greedy, the most important label first. Each tries positions on rings around its anchor, nearest
ring first, and gets the first box that overlaps no occupied one. A label without a free box within
the rings is left out; the caller reports how many were.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

_ANGLES = 16
_CELLS = 512
"""A cell is at least this part of the picture, so that a box touches few cells of any map."""


@dataclass(frozen=True, slots=True)
class Extent:
    """An upright box given by its middle and half sides."""

    x: float
    y: float
    half_width: float
    half_height: float

    def overlaps(self, other: "Extent") -> bool:
        """Whether the two boxes overlap."""
        return (
            abs(self.x - other.x) < self.half_width + other.half_width
            and abs(self.y - other.y) < self.half_height + other.half_height
        )

    def inside(self, bounds: tuple[float, float, float, float]) -> bool:
        """Whether the box lies within x0, y0, x1, y1."""
        x0, y0, x1, y1 = bounds
        return (
            self.x - self.half_width >= x0
            and self.x + self.half_width <= x1
            and self.y - self.half_height >= y0
            and self.y + self.half_height <= y1
        )


@dataclass(frozen=True, slots=True)
class LabelRequest:
    """An anchor (x, y) and the size of the label that belongs to it."""

    x: float
    y: float
    width: float
    height: float


def place_labels(
    requests: Sequence[LabelRequest],
    occupied: Iterable[Extent],
    bounds: tuple[float, float, float, float],
    rings: Sequence[float],
) -> list[Extent | None]:
    """For each requested label its box, or None where there was no room.

    ``rings`` are distances from the anchor to the box's nearest edge, ascending.
    """
    placed: list[Extent | None] = []
    x0, y0, x1, y1 = bounds
    sides = [side for label in requests for side in (label.width, label.height)]
    taken = _Taken(occupied, max([(x1 - x0) / _CELLS, (y1 - y0) / _CELLS, *sides]))
    for label in requests:
        boxes = (box for box in _candidates(label, rings) if box.inside(bounds))
        free = next((box for box in boxes if not taken.overlap(box)), None)
        if free is not None:
            taken.add(free)
        placed.append(free)
    return placed


class _Taken:
    """Boxes by the cells of a grid that they touch, so that a box is compared with those near it
    only."""

    def __init__(self, boxes: Iterable[Extent], cell_m: float) -> None:
        self._cell_m = cell_m
        self._by_cell: dict[tuple[int, int], list[Extent]] = {}
        for box in boxes:
            self.add(box)

    def add(self, box: Extent) -> None:
        for cell in self._cells(box):
            self._by_cell.setdefault(cell, []).append(box)

    def overlap(self, box: Extent) -> bool:
        """Whether one of the boxes overlaps ``box``."""
        return any(
            box.overlaps(other)
            for cell in self._cells(box)
            for other in self._by_cell.get(cell, ())
        )

    def _cells(self, box: Extent) -> Iterable[tuple[int, int]]:
        """The cells that a box touches; a little larger, as sums are rounded."""
        wide, high = box.half_width + 1e-6, box.half_height + 1e-6
        x0, x1 = (math.floor((box.x + side) / self._cell_m) for side in (-wide, wide))
        y0, y1 = (math.floor((box.y + side) / self._cell_m) for side in (-high, high))
        return product(range(x0, x1 + 1), range(y0, y1 + 1))


def _candidates(label: LabelRequest, rings: Sequence[float]) -> Iterable[Extent]:
    half_width, half_height = label.width / 2, label.height / 2
    for ring in rings:
        for step in range(_ANGLES):
            angle = math.tau * step / _ANGLES
            x = label.x + (ring + half_width) * math.cos(angle)
            y = label.y + (ring + half_height) * math.sin(angle)
            yield Extent(x, y, half_width, half_height)
