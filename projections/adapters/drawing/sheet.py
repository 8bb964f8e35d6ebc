"""The sheet a map is drawn on: a figure with axes in metres, and where labels have room on it.

Each place has a colour of its own; the rest of the picture is grey. Labels do not cover each other.
Their placement is greedy, the most important label first. Each tries positions on rings around its
anchor, nearest ring first, and gets the first box that overlaps no occupied one. A label without a
free box within the rings is left out; the caller reports how many were.
"""

import math
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Final

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import write_files
from projections.adapters.scene import HousePlan, drives
from projections.map.view import MapView

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


HALO = [withStroke(linewidth=2.2, foreground="white")]
SUFFIXES = (".png", ".svg", ".pdf")

_MARGIN_M = 0.35
_AROUND_POSES_M = 0.4
"""Added to the margin around poses, because a place's region reaches 0.55 m around its
keyframes."""
_WIDTH_IN = 13.0
_HEAD_IN, _FOOT_IN = 0.7, 0.5
_DPI = 120

Bounds = tuple[float, float, float, float]


@dataclass
class Sheet:
    """``bounds`` are x0, y0, x1, y1 of the drawn area; ``unit`` is the metres in a point.

    ``occupied`` are the boxes that labels must not cover.
    """

    figure: Figure
    axes: Axes
    bounds: Bounds
    unit: float
    occupied: list[Extent] = field(default_factory=list)

    def header(
        self, line: int, text: str, size: float, colour: str, weight: str = "normal"
    ) -> None:
        """A line of text above the map; lines are numbered from the top."""
        height = self.figure.get_figheight()
        y = 1 - (0.27 + 0.27 * line) / height
        self.figure.text(0.02, y, text, fontsize=size, color=colour, weight=weight, va="center")

    def footer(self, line: int, text: str, colour: str) -> None:
        """A line of text below the map; lines are numbered from the top."""
        y = (_FOOT_IN - 0.12 - 0.2 * line) / self.figure.get_figheight()
        self.figure.text(0.02, y, text, fontsize=8.5, color=colour, va="center")

    def save(self, out: Path) -> None:
        """Write the picture; the same picture gives the same bytes.

        Raises MisuseError where no file can be made there, MapfoldError where writing it fails.
        """
        suffix = out.suffix.lower()
        # PDF and SVG carry a date, SVG also ids with a random salt: left out, or fixed.
        undated = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
        write_files({out: self._drawn(suffix[1:], undated.get(suffix))})

    def png(self, dpi: int = _DPI) -> bytes:
        """The picture as a PNG."""
        return self._drawn("png", dpi=dpi)

    def _drawn(self, kind: str, metadata: dict[str, None] | None = None, dpi: int = _DPI) -> bytes:
        self._take_texts_literally()
        out = BytesIO()
        with _drawing():
            self.figure.savefig(out, dpi=dpi, format=kind, metadata=metadata)
        return out.getvalue()

    def _take_texts_literally(self) -> None:
        for text in self.figure.findobj(Text):
            text.set_parse_math(False)  # a class may be called "$5 bill$"
            text.set_text(_UNDRAWABLE.sub("\ufffd", text.get_text()))


_UNDRAWABLE: Final = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufeff\ufffe\uffff]")
"""What SVG, being XML, cannot hold, and the byte order mark, on which matplotlib's PDF fails."""


@contextmanager
def _drawing() -> Iterator[None]:
    with (
        rc_context({"svg.hashsalt": "mapfold", "svg.fonttype": "none"}),
        warnings.catch_warnings(),
    ):
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")  # drawn as a box
        yield


def check_suffix(out: Path) -> None:
    """Raise MisuseError unless the suffix of ``out`` is .png, .svg or .pdf."""
    if out.suffix.lower() not in SUFFIXES:
        raise MisuseError(f"{out}: a picture is .png, .svg or .pdf; give such a name")


def new_sheet(view: MapView, plan: HousePlan, more: Sequence[tuple[float, float]] = ()) -> Sheet:
    """An empty sheet that fits every pose of ``view``, wall of ``plan`` and spot of ``more``."""
    x0, y0, x1, y1 = bounds = _bounds(view, plan, more)
    height = _WIDTH_IN * (y1 - y0) / (x1 - x0) + _HEAD_IN + _FOOT_IN
    figure = Figure(figsize=(_WIDTH_IN, height), facecolor="white")
    axes = figure.add_axes((0.0, _FOOT_IN / height, 1.0, 1 - (_HEAD_IN + _FOOT_IN) / height))
    axes.set_xlim(x0, x1)
    axes.set_ylim(y0, y1)
    axes.set_aspect("equal")
    axes.set_axis_off()
    return Sheet(figure, axes, bounds, (x1 - x0) / (_WIDTH_IN * 72))


def _bounds(view: MapView, plan: HousePlan, more: Sequence[tuple[float, float]]) -> Bounds:
    reach = _AROUND_POSES_M
    poses = [spot for _, drive in drives(view) for spot in drive]
    spots = [(x + dx, y + dy) for x, y in poses for dx in (-reach, reach) for dy in (-reach, reach)]
    spots += [end for x0, y0, x1, y1 in plan.walls for end in ((x0, y0), (x1, y1))]
    spots += more
    if not spots:
        return (-2.0, -1.0, 2.0, 1.0)
    xs, ys = [x for x, _ in spots], [y for _, y in spots]
    x0, y0, x1, y1 = min(xs), min(ys), max(xs), max(ys)
    # A drive along a line still gets some area: wide ≥ high / 2, high ≥ wide / 3.
    wide, high = max(x1 - x0, (y1 - y0) / 2, 1.0), max(y1 - y0, (x1 - x0) / 3, 1.0)
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    dx, dy = wide / 2 + _MARGIN_M, high / 2 + _MARGIN_M
    return (x - dx, y - dy, x + dx, y + dy)
