"""Error inflation: the disagreement of two halves of a thing's views, in units of their errors.

Errors of lines of sight are correlated: a box shows the near side of a thing, or the part that a
table leaves visible; a stretch of a drive is off as a whole. Residuals about one position do not
show that. Two positions do, each from half of the views, split by side and by run: if errors were
independent, the square of their distance would be 2 in the mean, in units of its variance. The
quotient is the factor by which variances of bearings and poses are too small for a fold that treats
views as independent.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from projections.fold.spots import MAX_SPOTS, VIEWS_OF_A_SPOT

from .sightings import Floats, Ints, Sightings
from .things import Thing

LEAST_HALF = 3
MOST = MAX_SPOTS * VIEWS_OF_A_SPOT
"""The most views behind an estimate of the fold; further ones do not reduce its error."""
_ROUNDS = 6
_WORST = 20.0
_UNSURE_M2 = 1.0
"""A half with a larger error is not informative."""
_LEAST_M2 = 0.04
_FEW = 10.0
"""The number of things that weighs as much as the prior of independent errors."""


def inflation(
    things: Sequence[Thing], seen: Sightings, bearing_rad: float, cut_rad: float, pose_m: float
) -> float:
    """The factor by which variances are too small, 1 or more."""
    bearing_var = np.where(seen.cut, cut_rad**2, bearing_rad**2)
    found = [
        square
        for thing in things
        for first, second in _splits(thing, seen)
        if (square := _disagreement(thing, seen, first, second, bearing_var, pose_m**2)) is not None
    ]
    if not found:
        return 1.0
    quotient = float(np.minimum(found, _WORST).mean()) / 2.0
    share = len(found) / (len(found) + _FEW)
    return float(max(quotient, 1.0) ** share)


def _splits(thing: Thing, seen: Sightings) -> Iterator[tuple[Ints, Ints]]:
    """The views from one side and from the other; those of the first run and of later ones."""
    rows = thing.rows
    if len(rows) < 2 * LEAST_HALF:
        return
    sight = seen.sight[rows]
    middle = np.arctan2(np.sin(sight).sum(), np.cos(sight).sum())
    turned = np.remainder(sight - middle + np.pi, 2.0 * np.pi)
    order = rows[np.argsort(turned, kind="stable")]
    half = len(order) // 2
    yield order[:half], order[half:]
    runs = seen.run[rows]
    first = runs == runs.min()
    if LEAST_HALF <= int(first.sum()) <= len(rows) - LEAST_HALF:
        yield rows[first], rows[~first]


def _disagreement(
    thing: Thing,
    seen: Sightings,
    first: Ints,
    second: Ints,
    bearing_var: Floats,
    pose_var: float,
) -> float | None:
    """The squared distance of the two positions in units of its variance."""
    solved = [_position(thing, seen, rows, bearing_var[rows], pose_var) for rows in (first, second)]
    (x0, y0, info0), (x1, y1, info1) = solved
    if min(np.linalg.eigvalsh(info)[0] for info in (info0, info1)) < 1.0 / _UNSURE_M2:
        return None
    apart = np.array([x0 - x1, y0 - y1])
    covariance = np.linalg.inv(info0) + np.linalg.inv(info1)
    return float(apart @ np.linalg.solve(covariance, apart))


def _position(
    thing: Thing, seen: Sightings, rows: Ints, bearing_var: Floats, pose_var: float
) -> tuple[float, float, Floats]:
    """The point in which these lines of sight meet, starting from that of all of them, and the
    information matrix."""
    x, y, sight = seen.x[rows], seen.y[rows], seen.sight[rows]
    normals = np.stack([-np.sin(sight), np.cos(sight)], axis=1)
    offset = normals[:, 0] * x + normals[:, 1] * y
    at = np.array([thing.x, thing.y])
    counts = min(1.0, MOST / len(rows))
    for _ in range(_ROUNDS):
        square = np.maximum((at[0] - x) ** 2 + (at[1] - y) ** 2, _LEAST_M2)
        variance = bearing_var * square + pose_var
        past = offset - normals @ at
        weight = counts / (variance * (1.0 + past**2 / (4.0 * variance)))
        info = normals.T @ (normals * weight[:, None])
        if np.linalg.eigvalsh(info)[0] < 0.5 / _UNSURE_M2:
            return float(at[0]), float(at[1]), info
        at = np.linalg.solve(info, normals.T @ (weight * offset))
    return float(at[0]), float(at[1]), info
