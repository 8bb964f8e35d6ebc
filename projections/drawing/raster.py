"""How far each point of a sheet is from a place's keyframes, as far as that shows on a picture.

Beyond ``REACH_M`` a point is in no region, so a keyframe matters to the few points around it alone,
and its cost does not grow with the sheet. Two steps more are told exactly: the outline is drawn
between points on both of its sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

REACH_M = 0.55
"""A place's region reaches this far around its keyframes."""
FAR_M = 2 * REACH_M
"""What is said of all points that are further away than shows."""
_STEP_M = 0.05
_MAX_STEPS = 400

Grid = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Patch:
    """Metres to the nearest of some spots, for the rows and columns of the sheet around them."""

    rows: slice
    columns: slice
    field: Grid


class Raster:
    """Points ``xs`` by ``ys`` of the sheet ``bounds`` (x0, y0, x1, y1), in metres."""

    def __init__(self, bounds: tuple[float, float, float, float]) -> None:
        x0, y0, x1, y1 = bounds
        self.step = max(_STEP_M, (x1 - x0) / _MAX_STEPS, (y1 - y0) / _MAX_STEPS)
        self.xs: Grid = np.arange(x0, x1, self.step)
        self.ys: Grid = np.arange(y0, y1, self.step)

    def distances(self, spots: Sequence[tuple[float, float]]) -> Patch:
        """To the nearest of ``spots``, FAR_M where that is beyond what shows; empty for none."""
        near = [(*self.around(x, y), x, y) for x, y in spots]
        rows = _hull([each[0] for each in near])
        columns = _hull([each[1] for each in near])
        field = np.full((rows.stop - rows.start, columns.stop - columns.start), FAR_M)
        for own_rows, own_columns, x, y in near:
            part = field[_within(own_rows, rows), _within(own_columns, columns)]
            to_x, to_y = self.xs[None, own_columns] - x, self.ys[own_rows, None] - y
            np.minimum(part, np.hypot(to_x, to_y), out=part)
        return Patch(rows, columns, field)

    def around(self, x: float, y: float) -> tuple[slice, slice]:
        """Rows and columns of the points that a keyframe there matters to."""
        return self._span(self.ys, y), self._span(self.xs, x)

    def _span(self, points: Grid, middle: float) -> slice:
        reach = REACH_M + 2 * self.step
        first, last = np.searchsorted(points, (middle - reach, middle + reach))
        return slice(int(first), int(last))


def _hull(spans: Sequence[slice]) -> slice:
    start = min((span.start for span in spans), default=0)
    return slice(start, max((span.stop for span in spans), default=start))


def _within(span: slice, whole: slice) -> slice:
    return slice(span.start - whole.start, span.stop - whole.start)
