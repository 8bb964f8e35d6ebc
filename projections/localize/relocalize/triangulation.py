"""Triangulation: positions of things that look like a crop, where the map has no estimate.

Matches of one crop show one thing or look-alikes of it, so they share one size (pixel metres, see
`camera`). Given a size, each observation alone gives a point: bearing and depth from its pose. The
right size is the one under which observations from different poses agree on points; it is searched
on a grid (`_common_depth`). Points that agree within their errors are one landmark
(`cluster_points`). Wrong fusions and split Objects do no harm, because only observations are used.

A point's error is large along its ray, because the box's height is noisy, and small across it. So
two chairs half a metre apart can be separated from the side; with circular errors they would merge
into one landmark that fits neither. A landmark's position is the mean of its points weighted by
information (the inverse covariance): views along one ray leave the range uncertain, views that
cross do not. Points from one spot, closer than 0.35 m, share their errors and count as one and a
half. An error in the shared size moves all points outward together: by ``slide``, metres per unit
of log size.

BLAS is not used. The order of the candidates is the only one that affects results.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from projections.fold.evidence import EvidenceConstants

from .camera import Flags, Floats, Views

Indices = NDArray[np.intp]

_LOG_DEPTHS: Final = np.linspace(np.log(0.5), np.log(9.0), 22)
_DEPTHS: Final = np.exp(_LOG_DEPTHS)
_FOR_DEPTH: Final = 40
"""The number of most similar matches used to find the size; all pairs are compared."""
_AGREE_M: Final = 0.3
_MOST_APART: Final = 80.0 * _AGREE_M**2
"""Pairs of points that are farther apart at every depth, in square metres, agree by less than
exp(-40)."""
_LEAST_SQUARE: Final = 1e-300
_PER_AGREED: Final = -2.0 * _AGREE_M**2
_CUT_WEIGHT: Final = 0.2
_MIN_RANGE_M: Final = 0.3
_MIN_WEIGHT: Final = 0.05
_GATE: Final = 5.0
"""χ² below which a point belongs to a landmark."""
_LOG_DEPTH, _LOG_DEPTH_CUT = 0.12, 0.4
"""Error of the logarithm of a box's height."""
_LEAST_SIZE_ERROR: Final = 0.05
_LEAST_ERROR_M: Final = 0.1
_SPOT_M: Final = 0.35
_SPOT_COUNT: Final = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """A landmark: ``members`` index the observations; position in metres, covariance in m²."""

    members: Indices
    x: float
    y: float
    spread: tuple[float, float, float]


def triangulate(
    poses: Floats,
    boxes: Views,
    weight: Floats,
    starts: Indices,
    most: Sequence[int],
    evidence: EvidenceConstants,
) -> list[list[Triangulated]]:
    """The landmarks of each crop, the densest first and at most ``most``. ``poses`` (n, 3) in
    metres and radians, ``boxes`` and ``weight`` (n,) are of the observations, grouped by crop, the
    most similar first; ``starts`` has the index of each crop's first. Each crop has at least
    one."""
    counts = np.diff(starts, append=len(poses))
    cut = boxes.cut_x | boxes.cut_y | ~boxes.known
    weight = np.where(cut, _CUT_WEIGHT * weight, weight)
    rays = _rays(poses, boxes, starts, counts)
    depth, sigma = _common_depths(poses, rays, weight, starts, counts, evidence)
    sigma_of = sigma.repeat(counts)
    points = points_of(poses.T[:2], depth.repeat(counts) * rays, cut, sigma_of, evidence)
    members, owners = [], []
    for crop, (start, count) in enumerate(zip(starts.tolist(), counts.tolist(), strict=True)):
        part = slice(start, start + count)
        clusters = cluster_points(points.part(start, start + count), weight[part], most[crop])
        members += [start + each for each in clusters]
        owners += [crop] * len(clusters)
    sizes = np.array([len(each) for each in members])
    at = estimate_positions(points.subset(np.concatenate(members)), np.cumsum(sizes) - sizes)
    size = sigma[owners] ** 2
    sx, sy = at.slide
    spread = at.spread + size * np.array((sx * sx, sx * sy, sy * sy))
    found: list[list[Triangulated]] = [[] for _ in counts]
    rows = zip(owners, members, *at.xy.tolist(), *spread.tolist(), strict=True)
    for crop, of_it, x, y, xx, xy, yy in rows:
        found[crop].append(Triangulated(of_it, x, y, (xx, xy, yy)))
    return found


def _rays(poses: Floats, boxes: Views, starts: Indices, counts: Indices) -> Floats:
    """Vectors (2, n) from pose to thing, scaled so that a box of its crop's median height is at a
    depth of 1 m."""
    heights = boxes.height_px
    medians = [
        _median(heights[start : start + count])
        for start, count in zip(starts.tolist(), counts.tolist(), strict=True)
    ]
    relative = np.repeat(medians, counts) / heights
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    along: Floats = np.array((cos - boxes.slope * sin, sin + boxes.slope * cos))
    return along * relative


def _median(values: Floats) -> float:
    ordered = np.sort(values)
    return float(ordered[(len(values) - 1) // 2] + ordered[len(values) // 2]) / 2.0


@lru_cache(maxsize=_FOR_DEPTH)
def _pairs(count: int) -> tuple[Indices, Indices]:
    """The indices of all pairs of ``count`` items."""
    return np.triu_indices(count, 1)


def _common_depths(
    poses: Floats,
    rays: Floats,
    weight: Floats,
    starts: Indices,
    counts: Indices,
    evidence: EvidenceConstants,
) -> tuple[Floats, Floats]:
    """For each crop the depth of a box of median height under which points from different poses
    agree best, and the standard error of its logarithm, with the score taken as a
    log-likelihood."""
    used = np.minimum(counts, _FOR_DEPTH).tolist()
    pairs = [_pairs(each) for each in used]
    first, second = (
        np.concatenate(
            [start + pair[side] for start, pair in zip(starts.tolist(), pairs, strict=True)]
        )
        for side in (0, 1)
    )
    crop = np.repeat(np.arange(len(counts)), [len(pair[0]) for pair in pairs])
    px, py, rx, ry = (
        values.take(first) - values.take(second)
        for values in (*np.ascontiguousarray(poses.T[:2]), *rays)
    )
    pp, pr, rr = px * px + py * py, px * rx + py * ry, rx * rx + ry * ry
    apart = np.minimum(np.maximum((np.sqrt(pp) - 0.3) / 0.7, 0.0), 1.0)
    # only pairs that can agree by more than chance, and do so at one of the depths
    nearest = pp - pr * pr / np.maximum(rr, _LEAST_SQUARE)
    can = np.flatnonzero((apart > 0.0) & (nearest < _MOST_APART))
    apart = apart.take(can) * weight.take(first.take(can)) * weight.take(second.take(can))
    # (pp + 2 pr · depth + rr · depth²) / (-2 · agree²)
    agree = (rr.take(can) / _PER_AGREED) * _DEPTHS[:, None]
    agree += pr.take(can) * (2.0 / _PER_AGREED)
    agree *= _DEPTHS[:, None]
    agree += pp.take(can) / _PER_AGREED
    np.exp(agree, out=agree)
    agree *= apart
    crop = crop.take(can)
    usual = (np.log(_DEPTHS / evidence.range_m) / evidence.range_spread) ** 2
    ends = np.searchsorted(crop, np.arange(len(counts)), side="right").tolist()
    depth, sigma, begin = [], [], 0
    for start, count, end in zip(starts.tolist(), used, ends, strict=True):
        agreed = 2.0 * agree[:, begin:end].sum(1)
        total = float(weight[start : start + count].sum())
        score = 6.0 * agreed / max(1.0, total) - 0.5 * usual
        depth.append(_peak(score))
        sigma.append(max(_LEAST_SIZE_ERROR, _width(score)))
        begin = end
    return np.array(depth), np.array(sigma)


def _peak(score: Floats) -> float:
    """The grid's best depth, refined by the parabola through its neighbours."""
    best = int(np.argmax(score))
    if not 0 < best < len(_DEPTHS) - 1:
        return float(_DEPTHS[best])
    below, here, above = (float(s) for s in score[best - 1 : best + 2])
    curvature = below - 2.0 * here + above
    shift = 0.5 * (below - above) / curvature if curvature < 0 else 0.0
    return float(_DEPTHS[best] * (_DEPTHS[1] / _DEPTHS[0]) ** shift)


def _width(score: Floats) -> float:
    """The standard deviation of log depth under exp(score)."""
    share = np.exp(score - score.max())
    share /= share.sum()
    off = _LOG_DEPTHS - float((share * _LOG_DEPTHS).sum())
    return math.sqrt(float((share * off * off).sum()))


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """n points with the rays to them from where they were seen, in metres, as ``rows`` (15, n).

    ``sigma`` (2, n) are their standard errors along and perpendicular to the ray, whose unit
    vectors are ``direction`` (2, n). ``moments`` (7, n) are the terms of weighted sums: the inverse
    of a point's covariance (xx, xy, yy), that times the point, and that times the ray.
    """

    rows: Floats

    @property
    def count(self) -> int:
        """The number of points."""
        return len(self.rows[0])

    @property
    def xy(self) -> Floats:
        """Positions (2, n)."""
        return self.rows[:2]

    @property
    def ray(self) -> Floats:
        """Rays (2, n)."""
        return self.rows[2:4]

    @property
    def sigma(self) -> Floats:
        """Standard errors (2, n)."""
        return self.rows[4:6]

    @property
    def direction(self) -> Floats:
        """Unit vectors (2, n)."""
        return self.rows[6:8]

    @property
    def moments(self) -> Floats:
        """Moments (7, n)."""
        return self.rows[8:]

    def subset(self, index: Indices) -> "Points":
        """The points at ``index``."""
        return Points(self.rows.take(index, axis=1))

    def part(self, start: int, end: int) -> "Points":
        """The points from ``start`` to before ``end``."""
        return Points(self.rows[:, start:end])


def points_of(
    origin: Floats, ray: Floats, cut: Flags, sigma_size: Floats, evidence: EvidenceConstants
) -> Points:
    """Points at the ends of the rays (2, n) from ``origin`` (2, n); ``cut`` marks boxes that are
    cut off or missing, ``sigma_size`` (n,) is the error of the logarithm of the size."""
    found = Points(np.empty((15, len(cut))))
    length = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1])
    reach = np.maximum(length, _MIN_RANGE_M)
    depth = np.where(cut, _LOG_DEPTH_CUT, _LOG_DEPTH)
    bearing = np.where(cut, evidence.bearing_cut_rad, evidence.bearing_rad)
    square, pose = reach * reach, evidence.pose_m**2
    sigma = found.sigma
    sigma[0] = np.sqrt((depth * depth + sigma_size * sigma_size) * square + pose)
    sigma[1] = np.sqrt(bearing * bearing * square + pose)
    safe = np.where(length > 0, length, 1.0)
    ux, uy = np.where(length > 0, ray[0] / safe, 1.0), ray[1] / safe  # no length: along x
    a, b = 1.0 / (sigma * sigma)
    found.xy[:], found.ray[:] = origin + ray, ray
    found.direction[:] = ux, uy
    moments = found.moments
    moments[0] = m_xx = a * ux * ux + b * uy * uy
    moments[1] = m_xy = (a - b) * ux * uy
    moments[2] = m_yy = a * uy * uy + b * ux * ux
    for row, (x, y) in ((3, found.xy), (5, found.ray)):
        moments[row] = m_xx * x + m_xy * y
        moments[row + 1] = m_xy * x + m_yy * y
    return found


def cluster_points(points: Points, weight: Floats, most: int) -> list[Indices]:
    """Indices of the points of each cluster: around the densest point, then around the densest of
    the rest, and so on, at most ``most`` clusters."""
    near = np.exp(-0.5 * _chi_squared(points, points.xy[:, :, None]))
    free = np.ones(len(weight), dtype=bool)
    left = weight.copy()
    support = (near * left).sum(1)
    # what clusters take lowers the support of others, which is summed again only where it counts
    is_new = free.copy()
    found: list[Indices] = []
    while True:
        centre = int(support.argmax())
        while not is_new[centre]:
            support[centre] = (near[centre] * left).sum()
            is_new[centre] = True
            centre = int(support.argmax())
        mean = _weighted_mean(points, near[centre] * free)
        members = free & (_chi_squared(points, mean) < _GATE)
        members[centre] = True
        cluster = np.flatnonzero(members)
        found.append(cluster)
        free[cluster] = False
        if len(found) == most or not free.any():
            return found
        left[cluster] = 0.0
        support[cluster] = -1.0
        is_new[:] = False


@dataclass(frozen=True, slots=True)
class Positions:
    """The positions ``xy`` (2, n) of n landmarks in metres, their covariances ``spread`` (3, n),
    xx, xy and yy in m², and their slides (2, n)."""

    xy: Floats
    spread: Floats
    slide: Floats


def estimate_positions(points: Points, starts: Indices) -> Positions:
    """The positions of the things that ``points`` show, which are grouped by thing from ``starts``
    on; outliers have little weight."""
    counts = np.diff(starts, append=points.count)
    centre = np.array(_solve(*np.add.reduceat(points.moments[:5], starts, axis=1)))
    chi = _chi_squared(points, centre.repeat(counts, axis=1))
    weight = np.maximum(np.exp(-0.5 * chi), _MIN_WEIGHT)
    weight = weight * _share_of_spot(points.xy - points.ray, starts, counts)
    sums = np.add.reduceat(points.moments * weight, starts, axis=1)
    sxx, sxy, syy, x, y, ray_x, ray_y = sums
    det, least = sxx * syy - sxy * sxy, _LEAST_ERROR_M**2
    spread = np.array((syy / det + least, -sxy / det, sxx / det + least))
    slide = np.array(_solve(sxx, sxy, syy, ray_x, ray_y))
    return Positions(np.array(_solve(sxx, sxy, syy, x, y)), spread, slide)


def _share_of_spot(origin: Floats, starts: Indices, counts: Indices) -> Floats:
    """The weight of each point among the points of its thing from the same spot."""
    others = counts.repeat(counts)
    begin = np.cumsum(others) - others
    first = np.arange(len(others)).repeat(others)
    second = np.arange(len(first)) + (starts.repeat(counts) - begin).repeat(others)
    dx, dy = (values.take(first) - values.take(second) for values in origin)
    is_near = (dx * dx + dy * dy < _SPOT_M * _SPOT_M).view(np.int8)
    near = np.add.reduceat(is_near, begin, dtype=np.int64)
    share: Floats = np.minimum(_SPOT_COUNT / near, 1.0)
    return share


def _chi_squared(points: Points, to: Floats | tuple[float, float]) -> Floats:
    """χ² of each point being at ``to``, of shape (2,), (2, n) or (2, m, 1)."""
    ux, uy = points.direction
    sigma_along, sigma_across = points.sigma
    x, y = points.xy
    dx, dy = to[0] - x, to[1] - y
    along = (dx * ux + dy * uy) / sigma_along
    across = (dy * ux - dx * uy) / sigma_across
    chi: Floats = along * along + across * across
    return chi


def _weighted_mean(points: Points, weight: Floats) -> tuple[float, float]:
    """The mean position, weighted by ``weight`` and by information."""
    return _solve(*(points.moments[:5] * weight).sum(1).tolist())


Number = TypeVar("Number", float, Floats)


def _solve(xx: Number, xy: Number, yy: Number, x: Number, y: Number) -> tuple[Number, Number]:
    """Solve a symmetric 2 × 2 system: the vector that the matrix maps to (x, y); arrays solve many
    at once."""
    det = xx * yy - xy * xy
    return (yy * x - xy * y) / det, (xx * y - xy * x) / det
