"""Triangulation: positions of things that look like a crop, where the map has no estimate of them.

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

No BLAS, and results depend on no order but the candidates'.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from projections.evidence import EvidenceConstants

from .camera import Flags, Floats, Views

Indices = NDArray[np.intp]

_DEPTHS: Final = np.exp(np.linspace(np.log(0.5), np.log(9.0), 22))
_FOR_DEPTH: Final = 40
"""How many of the most similar matches are used to find the size; all pairs are compared."""
_AGREE_M: Final = 0.3
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
    poses: Floats, boxes: Views, weight: Floats, evidence: EvidenceConstants, most: int
) -> list[Triangulated]:
    """Landmarks, the densest first. ``poses`` (n, 3) in metres and radians, most similar first,
    ``weight`` (n,) how much each counts; n ≥ 1."""
    cut = boxes.cut_x | boxes.cut_y | ~boxes.known
    weight = np.where(cut, _CUT_WEIGHT * weight, weight)
    rays = _rays(poses, boxes)
    first = np.arange(min(_FOR_DEPTH, len(poses)))
    depth, sigma = _common_depth(poses[first], rays[first], weight[first], evidence)
    points = points_of(poses[:, :2], depth * rays, cut, sigma, evidence)
    found = []
    for members in cluster_points(points, weight, most):
        at = estimate_position(points.subset(members))
        (xx, xy, yy), (sx, sy) = at.spread, at.slide
        size = sigma * sigma
        spread = (xx + size * sx * sx, xy + size * sx * sy, yy + size * sy * sy)
        found.append(Triangulated(members, at.x, at.y, spread))
    return found


def _rays(poses: Floats, boxes: Views) -> Floats:
    """(n, 2) vectors from pose to thing, for a box of median height at a depth of 1 m."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    median_px = float(np.median(boxes.height_px))
    relative = median_px / boxes.height_px
    ahead = np.stack((cos, sin), axis=1)
    left = np.stack((-sin, cos), axis=1)
    rays: Floats = (ahead + boxes.slope[:, None] * left) * relative[:, None]
    return rays


def _common_depth(
    poses: Floats, rays: Floats, weight: Floats, evidence: EvidenceConstants
) -> tuple[float, float]:
    """The depth of a box of median height under which points from different poses agree best, and
    the standard error of its logarithm, with the score taken as a log-likelihood."""
    dp = poses[:, None, :2] - poses[None, :, :2]
    dr = rays[:, None] - rays[None]
    pp, pr, rr = (dp * dp).sum(2), (dp * dr).sum(2), (dr * dr).sum(2)
    apart = np.clip((np.sqrt(pp) - 0.3) / 0.7, 0.0, 1.0) * weight[:, None] * weight[None]
    upper = np.nonzero(np.triu(apart, 1))  # pairs that can agree by more than chance
    pp, pr, rr, apart = pp[upper], pr[upper], rr[upper], apart[upper]
    squared = pp + 2.0 * _DEPTHS[:, None] * pr + (_DEPTHS * _DEPTHS)[:, None] * rr
    agreed = 2.0 * (apart * np.exp(squared / (-2.0 * _AGREE_M**2))).sum(1)
    usual = (np.log(_DEPTHS / evidence.range_m) / evidence.range_spread) ** 2
    score = 6.0 * agreed / max(1.0, float(weight.sum())) - 0.5 * usual
    return _peak(score), max(_LEAST_SIZE_ERROR, _width(score))


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
    share = share / share.sum()
    logs = np.log(_DEPTHS)
    off = logs - float((share * logs).sum())
    return float(np.sqrt((share * off * off).sum()))


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points ``xy`` (n, 2) with the rays (n, 2) to them from where they were seen, in metres.

    ``sigma_along`` and ``sigma_across`` (n,) are their standard errors in and square to the ray's
    direction, whose unit vectors are ``direction`` (2, n). ``moments`` (7, n) are what weighted
    sums are made of: the inverse of a point's covariance (xx, xy, yy), that times the point, and
    that times the ray.
    """

    xy: Floats
    ray: Floats
    sigma_along: Floats
    sigma_across: Floats
    direction: Floats
    moments: Floats

    def subset(self, index: Indices) -> "Points":
        """Those at ``index``."""
        return Points(
            self.xy[index],
            self.ray[index],
            self.sigma_along[index],
            self.sigma_across[index],
            self.direction[:, index],
            self.moments[:, index],
        )


def points_of(
    origin: Floats, ray: Floats, cut: Flags, sigma_size: float, evidence: EvidenceConstants
) -> Points:
    """Points at the ends of the rays; ``cut`` marks boxes that are cut off or missing."""
    length = np.sqrt(ray[:, 0] ** 2 + ray[:, 1] ** 2)
    reach = np.maximum(length, _MIN_RANGE_M)
    depth = np.where(cut, _LOG_DEPTH_CUT, _LOG_DEPTH)
    bearing = np.where(cut, evidence.bearing_cut_rad, evidence.bearing_rad)
    square, pose = reach * reach, evidence.pose_m**2
    along = np.sqrt((depth * depth + sigma_size**2) * square + pose)
    across = np.sqrt(bearing * bearing * square + pose)
    safe = np.where(length > 0, length, 1.0)
    ux, uy = np.where(length > 0, ray[:, 0] / safe, 1.0), ray[:, 1] / safe  # no length: along x
    a, b = 1.0 / (along * along), 1.0 / (across * across)
    xy = origin + ray
    m_xx, m_xy, m_yy = a * ux * ux + b * uy * uy, (a - b) * ux * uy, a * uy * uy + b * ux * ux
    rows = [m_xx, m_xy, m_yy]
    for x, y in (xy.T, ray.T):
        rows += [m_xx * x + m_xy * y, m_xy * x + m_yy * y]
    return Points(xy, ray, along, across, np.stack((ux, uy)), np.stack(rows))


def cluster_points(points: Points, weight: Floats, most: int) -> list[Indices]:
    """Indices of the points of each cluster: around the densest point, then around the densest of
    the rest, and so on, at most ``most`` clusters."""
    near = np.exp(-0.5 * _chi_squared(points, points.xy[:, None, :]))
    free = np.ones(len(weight), dtype=bool)
    found: list[Indices] = []
    while free.any() and len(found) < most:
        support = (near * (weight * free)).sum(1)
        centre = int(np.argmax(np.where(free, support, -1.0)))
        mean = _weighted_mean(points, near[centre] * free)
        members = free & (_chi_squared(points, np.array(mean)) < _GATE)
        members[centre] = True
        found.append(np.flatnonzero(members))
        free &= ~members
    return found


@dataclass(frozen=True, slots=True)
class Position:
    """A landmark's position in metres, its covariance (xx, xy, yy) in m², and its slide."""

    x: float
    y: float
    spread: tuple[float, float, float]
    slide: tuple[float, float]


def estimate_position(points: Points) -> Position:
    """The position of the thing that all ``points`` show; outliers have little weight."""
    centre = np.array(_weighted_mean(points, np.ones(len(points.xy))))
    weight = np.maximum(np.exp(-0.5 * _chi_squared(points, centre)), _MIN_WEIGHT)
    weight = weight * _share_of_spot(points.xy - points.ray)
    sxx, sxy, syy, x, y, ray_x, ray_y = (points.moments * weight).sum(1).tolist()
    det, least = sxx * syy - sxy * sxy, _LEAST_ERROR_M**2
    spread = (syy / det + least, -sxy / det, sxx / det + least)
    return Position(*_solve(sxx, sxy, syy, x, y), spread, slide=_solve(sxx, sxy, syy, ray_x, ray_y))


def _share_of_spot(origin: Floats) -> Floats:
    """How much each point counts beside those from its spot."""
    dx = origin[:, 0, None] - origin[None, :, 0]
    dy = origin[:, 1, None] - origin[None, :, 1]
    near = (dx * dx + dy * dy < _SPOT_M * _SPOT_M).sum(1)
    share: Floats = np.minimum(_SPOT_COUNT / near, 1.0)
    return share


def _chi_squared(points: Points, to: Floats) -> Floats:
    """χ² of each point being at ``to``, of shape (2,) or (m, 1, 2)."""
    ux, uy = points.direction
    dx, dy = to[..., 0] - points.xy[:, 0], to[..., 1] - points.xy[:, 1]
    along = (dx * ux + dy * uy) / points.sigma_along
    across = (dy * ux - dx * uy) / points.sigma_across
    chi: Floats = along * along + across * across
    return chi


def _weighted_mean(points: Points, weight: Floats) -> tuple[float, float]:
    """The mean position, weighted by information too."""
    return _solve(*(points.moments[:5] * weight).sum(1).tolist())


def _solve(xx: float, xy: float, yy: float, x: float, y: float) -> tuple[float, float]:
    """The vector that the symmetric matrix takes to (x, y)."""
    det = xx * yy - xy * xy
    return (yy * x - xy * y) / det, (xx * y - xy * x) / det
