"""What a calibration uses: the observations of a folded map as columns, and the things that their
bearings alone triangulate well.

All constants are estimated from `Sightings`. Cosines of looks are exact: unit vectors are whole
multiples of 2⁻²⁰ (`projections.fold.exact`), so a product of two does not depend on the machine.

A thing qualifies by three observations or more, spots at least 0.8 m apart, lines of sight that
cross well (the smallest eigenvalue of the normal matrix Σ (I − d dᵀ) is at least 0.08 of their
number) and meet (median residual at most 0.35 rad). Its position is the robust least-squares
intersection of the lines of sight: one that passes it far off has little weight. There is no prior
of range or size, so that ranges and sizes can be estimated from it.

*Inflation* is the disagreement of two halves of a thing's views, in units of their errors. Errors
of lines of sight are correlated: a box shows the near side of a thing, or the part that a table
leaves visible; a stretch of a drive is off as a whole. Residuals about one position do not show
that. Two positions do, each from half of the views, split by side and by run: if errors were
independent, the square of their distance would be 2 in the mean, in units of its variance. The
quotient is the factor by which variances of bearings and poses are too small for a fold that treats
views as independent.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from projections.fold.deltas import Pose
from projections.fold.exact import Q40, UnitVector
from projections.fold.settings import CameraConstants
from projections.fold.spots import MAX_SPOTS, VIEWS_OF_A_SPOT
from projections.localize.relocalize.camera import Cameras, box_rows, camera_values, views

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
_BEYOND_PX = 2.0
"""Most pixels that a box may reach beyond the picture; more means another camera."""


class Row(NamedTuple):
    """One observation that was fused. ``picture`` and ``run`` are numbers of keyframe
    and run, ``thing`` that of the Object it was fused into."""

    picture: int
    run: int
    pose: Pose
    camera: CameraConstants
    class_name: str
    bbox: tuple[float, float, float, float]
    look: UnitVector | None
    thing: int


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Columns of equal length, one entry an observation, in the order of the fold.

    ``sight`` is the direction from the robot to the thing in the map frame, ``off_axis`` its angle
    from the picture's axis, left positive, radians. ``height`` is the box's height divided by the
    focal length, NaN where the picture's border cuts it at top or bottom. ``boxed`` is False where
    the box is empty: nothing is known of its direction then, ``looked`` where there is no
    embedding. ``beyond`` counts the boxes that reach
    beyond the picture.
    """

    picture: Ints
    run: Ints
    x: Floats
    y: Floats
    heading: Floats
    sight: Floats
    off_axis: Floats
    cut: Flags
    height: Floats
    boxed: Flags
    classes: Sequence[str]
    thing: Ints
    looks: Sequence[UnitVector | None]
    looked: Flags
    beyond: int

    def __len__(self) -> int:
        return len(self.picture)

    def cosines(self, a: Ints, b: Ints) -> Floats:
        """The cosine of each pair of observations, all of which have a look."""
        found = np.empty(len(a))
        for start in range(0, len(a), _PAIRS_AT_ONCE):
            part = slice(start, start + _PAIRS_AT_ONCE)
            left = np.array([self.looks[i] for i in a[part]], dtype=np.float64)
            right = np.array([self.looks[i] for i in b[part]], dtype=np.float64)
            found[part] = np.einsum("ij,ij->i", left, right) / Q40
        return found


_PAIRS_AT_ONCE = 4096


def sightings_of(rows: Iterable[Row]) -> Sightings:
    """The columns of observations."""
    rows = list(rows)
    boxes = box_rows([row.bbox for row in rows])
    cameras = Cameras.of([camera_values(row.camera) for row in rows])
    read = views(cameras, boxes)
    off_axis, whole = np.arctan(read.slope), read.known & ~read.cut_y
    x0, y0, x1, y1 = boxes.T
    beyond = (np.minimum(x0, y0) < -_BEYOND_PX) | (x1 > cameras.width_px + _BEYOND_PX)
    beyond |= y1 > cameras.height_px + _BEYOND_PX
    heading = np.array([row.pose.yaw_rad for row in rows], dtype=np.float64)
    return Sightings(
        picture=np.array([row.picture for row in rows], dtype=np.int64),
        run=np.array([row.run for row in rows], dtype=np.int64),
        x=np.array([row.pose.x_m for row in rows], dtype=np.float64),
        y=np.array([row.pose.y_m for row in rows], dtype=np.float64),
        heading=heading,
        sight=heading + cameras.yaw_rad + off_axis,
        off_axis=off_axis,
        cut=read.cut_x,
        height=np.where(whole, read.height_px / cameras.focal_px, np.nan),
        boxed=read.known,
        classes=[row.class_name for row in rows],
        thing=np.array([row.thing for row in rows], dtype=np.int64),
        looks=[row.look for row in rows],
        looked=np.array([row.look is not None for row in rows], dtype=np.bool_),
        beyond=int(beyond.sum()),
    )


LEAST_OBSERVATIONS = 3
SPOT_M = 0.8
LEAST_CROSSING = 0.08
MOST_RESIDUAL_RAD = 0.35
_ROUNDS = 12
_LEAST_RANGE_M = 0.2
"""A thing nearer than that counts as that near: a bearing's weight is finite."""


class QualifiedThing(NamedTuple):
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


def qualified(
    seen: Sightings, bearing_rad: float, cut_rad: float, pose_m: float
) -> list[QualifiedThing]:
    """The things that qualify, ascending. The errors are what bearings are weighed by."""
    boxed = np.flatnonzero(seen.boxed & (seen.thing >= 0))
    order = boxed[np.argsort(seen.thing[boxed], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(seen.thing[order])) + 1)
    variance = np.where(seen.cut, cut_rad**2, bearing_rad**2)
    found = (_triangulate(seen, rows, variance[rows], pose_m**2) for rows in groups if len(rows))
    return [thing for thing in found if thing is not None]


def _triangulate(
    seen: Sightings, rows: Ints, bearing_var: Floats, pose_var: float
) -> QualifiedThing | None:
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
    return QualifiedThing(
        int(seen.thing[rows[0]]), float(px), float(py), rows, distance, residual, leverage
    )


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


LEAST_HALF = 3
MOST = MAX_SPOTS * VIEWS_OF_A_SPOT
"""The most views behind an estimate of the fold; further ones do not reduce its error."""
_ROUNDS_OF_A_HALF = 6
_WORST = 20.0
_UNSURE_M2 = 1.0
"""A half with a larger error is not informative."""
_LEAST_M2 = 0.04
_FEW = 10.0
"""The number of things that weighs as much as the prior of independent errors."""


def inflation(
    things: Sequence[QualifiedThing],
    seen: Sightings,
    bearing_rad: float,
    cut_rad: float,
    pose_m: float,
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


def _splits(thing: QualifiedThing, seen: Sightings) -> Iterator[tuple[Ints, Ints]]:
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
    thing: QualifiedThing,
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
    thing: QualifiedThing, seen: Sightings, rows: Ints, bearing_var: Floats, pose_var: float
) -> tuple[float, float, Floats]:
    """The point in which these lines of sight meet, starting from that of all of them, and the
    information matrix."""
    x, y, sight = seen.x[rows], seen.y[rows], seen.sight[rows]
    normals = np.stack([-np.sin(sight), np.cos(sight)], axis=1)
    offset = normals[:, 0] * x + normals[:, 1] * y
    at = np.array([thing.x, thing.y])
    counts = min(1.0, MOST / len(rows))
    for _ in range(_ROUNDS_OF_A_HALF):
        square = np.maximum((at[0] - x) ** 2 + (at[1] - y) ** 2, _LEAST_M2)
        variance = bearing_var * square + pose_var
        past = offset - normals @ at
        weight = counts / (variance * (1.0 + past**2 / (4.0 * variance)))
        info = normals.T @ (normals * weight[:, None])
        if np.linalg.eigvalsh(info)[0] < 0.5 / _UNSURE_M2:
            return float(at[0]), float(at[1]), info
        at = np.linalg.solve(info, normals.T @ (weight * offset))
    return float(at[0]), float(at[1]), info
