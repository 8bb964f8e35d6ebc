"""From matches to landmarks: where do the things stand that look like this crop?

Matches of one crop show one thing or look-alikes of it, so they share one size (pixel metres, see
`camera`), and with a size every observation alone gives a point: bearing and depth from its pose.
The right size is the one under which observations from different poses agree on points; it is
searched on a grid. Points that agree within their errors are one landmark (`clusters`). Neither
wrong fusions nor split Objects matter here, because only observations are looked at.

Each landmark carries a table: how well its members' similarities fit, for a robot that looks at it
from each direction (`_evidence`). From the side that was seen before a crop must be more similar
than from behind; a look-alike fits a little worse from everywhere.

No BLAS and no order but the candidates': the same candidates give the same landmarks.

Points of one crop's matches grouped into things, and how sure the place of each thing is.

A match's point is unsure along its ray, because the box's height is noisy, and hardly across it: a
bearing is good to about a degree. So two chairs half a metre apart are told apart from the side,
where one circle around every point would melt them into one thing that fits neither. A thing's
place is the mean weighted by information (the inverse of those errors); three views along one ray
leave the range open, two that cross do not.

The crops of a thing share one size, so an error in it moves all points outward together: by
``slide``, metres per unit of log size.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .camera import Flags, Floats, Views
from .model import Model
from .sessions import Sessions, settled

Indices = NDArray[np.intp]

_LEAST_REACH_M = 0.3
_LEAST_PULL = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points (n, 2) with the rays (n, 2) that lead to them from where they were seen, in metres.

    ``along`` and ``across`` (n,) are their standard errors in and square to the ray's direction,
    whose unit vectors ``ahead`` holds (2, n). ``moments`` (7, n) are what weighted sums are made
    of: the inverse of a point's covariance (xx, xy, yy), that times the point, and that times the
    ray.
    """

    at: Floats
    ray: Floats
    along: Floats
    across: Floats
    ahead: Floats
    moments: Floats

    def of(self, index: Indices) -> "Points":
        """Those at ``index``."""
        return Points(
            self.at[index],
            self.ray[index],
            self.along[index],
            self.across[index],
            self.ahead[:, index],
            self.moments[:, index],
        )


def points_of(origin: Floats, ray: Floats, cut: Flags, sigma_size: float, model: Model) -> Points:
    """Points at the ends of the rays; ``cut`` marks boxes that are cut off or missing."""
    length = np.sqrt(ray[:, 0] ** 2 + ray[:, 1] ** 2)
    reach = np.maximum(length, _LEAST_REACH_M)
    depth = np.where(cut, model.map_log_depth_cut, model.map_log_depth)
    bearing = np.where(cut, model.map_bearing_cut, model.map_bearing)
    along = np.sqrt(depth * depth + sigma_size**2) * reach + model.map_least
    across = bearing * reach + model.map_least
    safe = np.where(length > 0, length, 1.0)
    ux, uy = np.where(length > 0, ray[:, 0] / safe, 1.0), ray[:, 1] / safe  # no length: along x
    a, b = 1.0 / (along * along), 1.0 / (across * across)
    at = origin + ray
    xx, xy, yy = a * ux * ux + b * uy * uy, (a - b) * ux * uy, a * uy * uy + b * ux * ux
    rows = [xx, xy, yy]
    for x, y in (at.T, ray.T):
        rows += [xx * x + xy * y, xy * x + yy * y]
    return Points(at, ray, along, across, np.stack((ux, uy)), np.stack(rows))


def clusters(points: Points, weight: Floats, most: int, model: Model) -> list[Indices]:
    """Grouped around the densest point, then around the densest of the rest, and so on."""
    chi = _misfit(points, points.at[:, None, :])
    near = np.exp(-0.5 * chi)
    free = np.ones(len(weight), dtype=bool)
    found: list[Indices] = []
    while free.any() and len(found) < most:
        support = (near * (weight * free)).sum(1)
        centre = int(np.argmax(np.where(free, support, -1.0)))
        place = _mean(points, near[centre] * free)
        mine = free & (_misfit(points, np.array(place)) < model.gate)
        mine[centre] = True
        found.append(np.flatnonzero(mine))
        free &= ~mine
    return found


@dataclass(frozen=True, slots=True)
class Settled:
    """A thing's place in metres; ``spread`` is the covariance (xx, xy, yy) of it in m²."""

    x: float
    y: float
    spread: tuple[float, float, float]
    slide: tuple[float, float]


def settle(points: Points, model: Model) -> Settled:
    """The place of the thing that all ``points`` show, outliers counting little."""
    centre = np.array(_mean(points, np.ones(len(points.at))))
    pull = np.maximum(np.exp(-0.5 * _misfit(points, centre)), _LEAST_PULL)
    sxx, sxy, syy, x, y, ray_x, ray_y = (points.moments * pull).sum(1).tolist()
    det, least = sxx * syy - sxy * sxy, model.sigma_landmark**2
    spread = (syy / det + least, -sxy / det, sxx / det + least)
    at = _solve(sxx, sxy, syy, x, y)
    return Settled(*at, spread, _solve(sxx, sxy, syy, ray_x, ray_y))


def _misfit(points: Points, to: Floats) -> Floats:
    """χ² of each point being at ``to``, of shape (2,) or (m, 1, 2)."""
    ux, uy = points.ahead
    dx, dy = to[..., 0] - points.at[:, 0], to[..., 1] - points.at[:, 1]
    along, across = (dx * ux + dy * uy) / points.along, (dy * ux - dx * uy) / points.across
    chi: Floats = along * along + across * across
    return chi


def _mean(points: Points, weight: Floats) -> tuple[float, float]:
    """The mean place, weighted by information too."""
    return _solve(*(points.moments[:5] * weight).sum(1).tolist())


def _solve(xx: float, xy: float, yy: float, x: float, y: float) -> tuple[float, float]:
    """The vector that the symmetric matrix takes to (x, y)."""
    det = xx * yy - xy * xy
    return (yy * x - xy * y) / det, (xx * y - xy * x) / det


DIRECTIONS: Final = 36
"""Directions in a landmark's table, 10° apart."""
MAX_LANDMARKS: Final = 8
_DEPTHS: Final = np.exp(np.linspace(np.log(0.5), np.log(6.5), 20))
_FOR_DEPTH: Final = 40
"""The most similar matches suffice to find the size; all pairs of them are compared."""
_AGREE_M: Final = 0.3
_CUT_WEIGHT: Final = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """A thing that may be the crop. ``members`` index the crop's posed matches.

    ``spread`` (xx, xy, yy in m²) and ``slide`` (metres per unit of log size) say how unsure its
    place is, see `clusters`.
    """

    x: float
    y: float
    members: Indices
    table: Floats
    spread: tuple[float, float, float]
    slide: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """The landmarks of one crop, best first, and the size (pixel metres) they share."""

    items: tuple[Landmark, ...]
    size: float
    sigma_log_size: float


def find_landmarks(
    poses: Floats, views: Views, similarity: Floats, sessions: Sessions, model: Model
) -> Landmarks:
    """``poses`` of shape (n, 3) in metres and radians, ``similarity`` of shape (n,); n ≥ 1."""
    weight = np.clip((similarity - model.relevant) / 0.05, 0.1, 1.0)
    weight = np.where(views.cut_x | views.cut_y | ~views.known, _CUT_WEIGHT * weight, weight)
    rays, median_px = _rays(poses, views)
    most = np.arange(min(_FOR_DEPTH, len(poses)))
    depth, sigma = _common_depth(poses[most], rays[most], weight[most], model)
    cut = views.cut_x | views.cut_y | ~views.known
    points = points_of(poses[:, :2], depth * rays, cut, sigma, model)
    found = []
    for members in clusters(points, weight, 3 * MAX_LANDMARKS, model):
        spot = settle(points.of(members), model)
        of_runs = sessions.of(members)
        table = _evidence(poses[members], spot.x, spot.y, similarity[members], of_runs, model)
        found.append(Landmark(spot.x, spot.y, members, table, spot.spread, spot.slide))
    found.sort(key=lambda landmark: (-float(landmark.table.max()), int(landmark.members[0])))
    return Landmarks(tuple(found[:MAX_LANDMARKS]), depth * median_px, sigma)


def _rays(poses: Floats, views: Views) -> tuple[Floats, float]:
    """Per observation the vector to its thing, were the median height at a depth of 1 m."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    median_px = float(np.median(views.height_px))
    relative = median_px / views.height_px
    ahead = np.stack((cos, sin), axis=1)
    left = np.stack((-sin, cos), axis=1)
    return (ahead + views.slope[:, None] * left) * relative[:, None], median_px


def _common_depth(poses: Floats, rays: Floats, weight: Floats, model: Model) -> tuple[float, float]:
    """The depth of the median height under which points from different poses agree best.

    With it the standard error of its logarithm, the score taken for a log-likelihood.
    """
    dp = poses[:, None, :2] - poses[None, :, :2]
    dr = rays[:, None] - rays[None]
    pp, pr, rr = (dp * dp).sum(2), (dp * dr).sum(2), (dr * dr).sum(2)
    apart = np.clip((np.sqrt(pp) - 0.3) / 0.7, 0.0, 1.0) * weight[:, None] * weight[None]
    upper = np.nonzero(np.triu(apart, 1))  # pairs that can agree by more than chance
    pp, pr, rr, apart = pp[upper], pr[upper], rr[upper], apart[upper]
    squared = pp + 2.0 * _DEPTHS[:, None] * pr + (_DEPTHS * _DEPTHS)[:, None] * rr
    agreed = 2.0 * (apart * np.exp(squared / (-2.0 * _AGREE_M**2))).sum(1)
    usual = (np.log(_DEPTHS / model.usual_depth) / model.usual_depth_spread) ** 2
    score = 6.0 * agreed / max(1.0, float(weight.sum())) - 0.5 * usual
    return _peak(score), max(model.sigma_size_least, _width(score))


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


def _evidence(
    poses: Floats, x: float, y: float, similarity: Floats, sessions: Sessions, model: Model
) -> Floats:
    """Log-likelihood (up to a constant) per direction from which the robot looks at the thing."""
    directions = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
    seen_from = np.arctan2(poses[:, 1] - y, poses[:, 0] - x)
    apart = np.cos(directions[:, None] - seen_from[None])
    expected = model.floor + model.side * np.exp(model.kappa * (apart - 1.0))
    error = np.minimum(similarity, model.usual_best)[None] - expected
    error, paid = settled(error, sessions, model) if sessions.several else (error, 0.0)
    mean = error.mean(1)
    count = min(float(len(similarity)), model.independent)
    scatter = ((error - mean[:, None]) ** 2).mean(1) * (count / model.sigma_observation**2)
    offset = mean * mean / (model.sigma_instance**2 + model.sigma_observation**2 / count)
    offset = np.where(mean > 0, np.minimum(offset, model.too_similar), offset)
    degrees = min(len(similarity) - 1.0, model.independent)
    table: Floats = np.minimum(-0.5 * (scatter - 0.5 * degrees + offset) - paid, 1.5)
    if float(similarity.max()) > model.usual_best + model.same_crop:
        table = table + model.same_crop_worth
    return table
