"""Things that a calibration uses: those that their bearings alone triangulate well.

A thing qualifies by three observations or more, spots at least 0.8 m apart, lines of sight that
cross well (the smallest eigenvalue of the normal matrix Σ (I − d dᵀ) is at least 0.08 of their
number) and meet (median residual at most 0.35 rad). Its position is the robust least-squares
intersection of the lines of sight: one that passes it far off has little weight. There is no prior
of range or size, so that ranges and sizes can be estimated from it.
"""

import math
from typing import NamedTuple

import numpy as np

from .sightings import Floats, Ints, Sightings

LEAST_OBSERVATIONS = 3
SPOT_M = 0.8
LEAST_CROSSING = 0.08
MOST_RESIDUAL_RAD = 0.35
_ROUNDS = 12
_LEAST_RANGE_M = 0.2
"""A thing nearer than that counts as that near: a bearing's weight is finite."""


class Thing(NamedTuple):
    """A thing that qualified.

    ``rows`` are its observations with a box, ``range`` their distances in metres, ``residual``
    their bearings less those of the position, radians to the left; ``leverage`` is how far
    each draws the position to itself, 0 to 1: (1 − leverage) of its variance is in its residual.
    """

    thing: int
    x: float
    y: float
    rows: Ints
    range: Floats
    residual: Floats
    leverage: Floats


def qualified(seen: Sightings, bearing_rad: float, cut_rad: float, pose_m: float) -> list[Thing]:
    """The things that qualify, ascending. The errors are what bearings are weighed by."""
    boxed = np.flatnonzero(seen.boxed & (seen.thing >= 0))
    order = boxed[np.argsort(seen.thing[boxed], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(seen.thing[order])) + 1)
    variance = np.where(seen.cut, cut_rad**2, bearing_rad**2)
    found = (_triangulate(seen, rows, variance[rows], pose_m**2) for rows in groups if len(rows))
    return [thing for thing in found if thing is not None]


def _triangulate(seen: Sightings, rows: Ints, bearing_var: Floats, pose_var: float) -> Thing | None:
    if len(rows) < LEAST_OBSERVATIONS or not _far_apart(seen.x[rows], seen.y[rows]):
        return None
    x, y, sight = seen.x[rows], seen.y[rows], seen.sight[rows]
    along_x, along_y = np.cos(sight), np.sin(sight)
    across_x, across_y = -along_y, along_x  # the line's normal: I − d dᵀ = normal normalᵀ
    offset = across_x * x + across_y * y
    weight = np.ones(len(rows))
    if _smallest_eigenvalue(across_x, across_y, weight) < LEAST_CROSSING * len(rows):
        return None
    for _ in range(_ROUNDS):
        xx, xy, yy = _normal_matrix(across_x, across_y, weight)
        det = xx * yy - xy * xy
        right_x, right_y = weight @ (across_x * offset), weight @ (across_y * offset)
        px = (yy * right_x - xy * right_y) / det
        py = (xx * right_y - xy * right_x) / det
        past = offset - across_x * px - across_y * py
        distance = np.maximum(np.hypot(px - x, py - y), _LEAST_RANGE_M)
        variance = bearing_var * distance**2 + pose_var
        # Cauchy's weights: a line of sight of another thing hardly counts.
        weight = 1.0 / (variance * (1.0 + past**2 / (4.0 * variance)))
        if _smallest_eigenvalue(across_x, across_y, weight) < 1e-3 * weight.sum():
            return None
    ahead = (px - x) * along_x + (py - y) * along_y
    residual = -np.arctan2((px - x) * across_x + (py - y) * across_y, ahead)
    if float(np.median(np.abs(residual))) > MOST_RESIDUAL_RAD:
        return None
    xx, xy, yy = _normal_matrix(across_x, across_y, weight)
    det = xx * yy - xy * xy
    spread = (yy * across_x**2 - 2.0 * xy * across_x * across_y + xx * across_y**2) / det
    leverage = np.clip(weight * spread, 0.0, 1.0)
    return Thing(int(seen.thing[rows[0]]), float(px), float(py), rows, distance, residual, leverage)


def _far_apart(x: Floats, y: Floats) -> bool:
    """Whether two of the points are `SPOT_M` or more apart."""
    if math.hypot(x.max() - x.min(), y.max() - y.min()) < SPOT_M:
        return False
    return any(bool((np.hypot(x - a, y - b) >= SPOT_M).any()) for a, b in zip(x, y, strict=True))


def _normal_matrix(nx: Floats, ny: Floats, weight: Floats) -> tuple[float, float, float]:
    return (
        float(weight @ (nx * nx)),
        float(weight @ (nx * ny)),
        float(weight @ (ny * ny)),
    )


def _smallest_eigenvalue(nx: Floats, ny: Floats, weight: Floats) -> float:
    xx, xy, yy = _normal_matrix(nx, ny, weight)
    return (xx + yy) / 2.0 - math.hypot((xx - yy) / 2.0, xy)
