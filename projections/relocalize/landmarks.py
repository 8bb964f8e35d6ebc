"""Landmarks: positions of things in the map that look like a crop, triangulated from its matches.

Matches of one crop show one thing or look-alikes of it, so they share one size (pixel metres, see
`camera`). Given a size, each observation alone gives a point: bearing and depth from its pose. The
right size is the one under which observations from different poses agree on points; it is searched
on a grid (`_common_depth`). Points that agree within their errors are one landmark
(`cluster_points`). Wrong fusions and split Objects do no harm, because only observations are used.

A point's error is large along its ray, because the box's height is noisy, and small across it: a
bearing is good to about a degree. So two chairs half a metre apart can be separated from the side;
with circular errors they would merge into one landmark that fits neither. A landmark's position is
the mean of its points weighted by information (the inverse covariance): views along one ray leave
the range uncertain, views that cross do not. An error in the shared size moves all points outward
together: by ``slide``, metres per unit of log size.

Each landmark has a table: how well its members' similarities fit a robot that looks at it from each
direction (`_similarity_table`). From a side that was seen before, a crop must be more similar than
from behind; a look-alike fits a little worse from every direction.

No BLAS, and results depend on no order but the candidates'.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .camera import Camera, Flags, Floats, Views, views
from .candidates import Match
from .model import Model
from .question import Crop
from .sessions import (
    RemainingShifts,
    apply_remaining_shifts,
    remaining_shifts,
    session_shifts,
    subtract_shifts,
)

Indices = NDArray[np.intp]

DIRECTIONS: Final = 36
"""Directions in a landmark's table, 10° apart."""
MAX_LANDMARKS: Final = 8
_NEAREST_M, _FARTHEST_M = 0.5, 6.0
_DEPTHS: Final = np.exp(np.linspace(np.log(0.5), np.log(6.5), 20))
_FOR_DEPTH: Final = 40
"""How many of the most similar matches are used to find the size; all pairs are compared."""
_AGREE_M: Final = 0.3
_CUT_WEIGHT: Final = 0.2
_MIN_RANGE_M: Final = 0.3
_MIN_WEIGHT: Final = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkHypothesis:
    """A thing in the map that may be the crop. ``members`` index the crop's posed matches.

    ``spread`` (covariance xx, xy, yy in m²) and ``slide`` (metres per unit of log size) are the
    errors of its position. ``table`` (DIRECTIONS,) is a log-likelihood.
    """

    x: float
    y: float
    members: Indices
    table: Floats
    spread: tuple[float, float, float]
    slide: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class CropEvidence:
    """A crop and its landmarks, best first. Their members index ``poses`` of shape (n, 3).

    ``bearing`` (radians, left positive) is None without a box, and ``depth`` (metres ahead) then
    means nothing. ``cut_x`` and ``cut_y`` say that the picture's edge cut the box,
    ``sigma_log_size`` how unsure the size is that depth and landmarks share.
    """

    landmarks: tuple[LandmarkHypothesis, ...]
    poses: Floats
    bearing: float | None
    depth: float
    cut_x: bool
    cut_y: bool
    sigma_log_size: float


def crop_evidence(
    crops: Sequence[Crop], matches: Sequence[Sequence[Match]], camera: Camera, model: Model
) -> tuple[CropEvidence, ...]:
    """The evidence of each crop that has a relevant match with a pose."""
    shifts, found = session_shifts(matches, model), []
    for crop, row in zip(crops, matches, strict=True):
        relevant = [
            m
            for m in subtract_shifts(row, shifts)
            if m.pose is not None and m.similarity > model.relevant
        ]
        if relevant:
            remaining = remaining_shifts(relevant, shifts, model)
            found.append(_evidence_of(crop, relevant, remaining, camera, model))
    return tuple(found)


def _evidence_of(
    crop: Crop, matches: Sequence[Match], remaining: RemainingShifts, camera: Camera, model: Model
) -> CropEvidence:
    poses = np.array([m.pose for m in matches], dtype=np.float64)
    similarity = np.array([m.similarity for m in matches], dtype=np.float64)
    boxes = views(camera, [m.bbox for m in matches])
    landmarks, size, sigma = _find_landmarks(poses, boxes, similarity, remaining, model)
    own = views(camera, [crop.bbox])
    known = bool(own.known[0])
    depth = size / float(own.height_px[0])
    return CropEvidence(
        landmarks,
        poses,
        math.atan(float(own.slope[0])) if known else None,
        min(max(depth, _NEAREST_M), _FARTHEST_M),
        bool(own.cut_x[0]),
        bool(own.cut_y[0]),
        sigma,
    )


def _find_landmarks(
    poses: Floats, boxes: Views, similarity: Floats, remaining: RemainingShifts, model: Model
) -> tuple[tuple[LandmarkHypothesis, ...], float, float]:
    """Landmarks of one crop, best first, the size they share (pixel metres), its log's error.

    ``poses`` of shape (n, 3) in metres and radians, ``similarity`` of shape (n,); n ≥ 1.
    """
    weight = np.clip((similarity - model.relevant) / 0.05, 0.1, 1.0)
    cut = boxes.cut_x | boxes.cut_y | ~boxes.known
    weight = np.where(cut, _CUT_WEIGHT * weight, weight)
    rays, median_px = _rays(poses, boxes)
    most = np.arange(min(_FOR_DEPTH, len(poses)))
    depth, sigma = _common_depth(poses[most], rays[most], weight[most], model)
    points = points_of(poses[:, :2], depth * rays, cut, sigma, model)
    found = []
    for members in cluster_points(points, weight, 3 * MAX_LANDMARKS, model):
        at = estimate_position(points.subset(members), model)
        table = _similarity_table(members, at, poses, similarity, remaining, model)
        found.append(LandmarkHypothesis(at.x, at.y, members, table, at.spread, at.slide))
    found.sort(key=lambda landmark: (-float(landmark.table.max()), int(landmark.members[0])))
    return tuple(found[:MAX_LANDMARKS]), depth * median_px, sigma


def _rays(poses: Floats, boxes: Views) -> tuple[Floats, float]:
    """(n, 2) vectors from pose to thing, for a box of median height at a depth of 1 m, and that
    height in pixels."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    median_px = float(np.median(boxes.height_px))
    relative = median_px / boxes.height_px
    ahead = np.stack((cos, sin), axis=1)
    left = np.stack((-sin, cos), axis=1)
    return (ahead + boxes.slope[:, None] * left) * relative[:, None], median_px


def _common_depth(poses: Floats, rays: Floats, weight: Floats, model: Model) -> tuple[float, float]:
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


def points_of(origin: Floats, ray: Floats, cut: Flags, sigma_size: float, model: Model) -> Points:
    """Points at the ends of the rays; ``cut`` marks boxes that are cut off or missing."""
    length = np.sqrt(ray[:, 0] ** 2 + ray[:, 1] ** 2)
    reach = np.maximum(length, _MIN_RANGE_M)
    depth = np.where(cut, model.map_log_depth_cut, model.map_log_depth)
    bearing = np.where(cut, model.map_bearing_cut, model.map_bearing)
    along = np.sqrt(depth * depth + sigma_size**2) * reach + model.map_least
    across = bearing * reach + model.map_least
    safe = np.where(length > 0, length, 1.0)
    ux, uy = np.where(length > 0, ray[:, 0] / safe, 1.0), ray[:, 1] / safe  # no length: along x
    a, b = 1.0 / (along * along), 1.0 / (across * across)
    xy = origin + ray
    m_xx, m_xy, m_yy = a * ux * ux + b * uy * uy, (a - b) * ux * uy, a * uy * uy + b * ux * ux
    rows = [m_xx, m_xy, m_yy]
    for x, y in (xy.T, ray.T):
        rows += [m_xx * x + m_xy * y, m_xy * x + m_yy * y]
    return Points(xy, ray, along, across, np.stack((ux, uy)), np.stack(rows))


def cluster_points(points: Points, weight: Floats, most: int, model: Model) -> list[Indices]:
    """Indices of the points of each cluster: around the densest point, then around the densest of
    the rest, and so on, at most ``most`` clusters."""
    near = np.exp(-0.5 * _chi_squared(points, points.xy[:, None, :]))
    free = np.ones(len(weight), dtype=bool)
    found: list[Indices] = []
    while free.any() and len(found) < most:
        support = (near * (weight * free)).sum(1)
        centre = int(np.argmax(np.where(free, support, -1.0)))
        mean = _weighted_mean(points, near[centre] * free)
        members = free & (_chi_squared(points, np.array(mean)) < model.gate)
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


def estimate_position(points: Points, model: Model) -> Position:
    """The position of the thing that all ``points`` show; outliers have little weight."""
    centre = np.array(_weighted_mean(points, np.ones(len(points.xy))))
    weight = np.maximum(np.exp(-0.5 * _chi_squared(points, centre)), _MIN_WEIGHT)
    sxx, sxy, syy, x, y, ray_x, ray_y = (points.moments * weight).sum(1).tolist()
    det, least = sxx * syy - sxy * sxy, model.sigma_landmark**2
    spread = (syy / det + least, -sxy / det, sxx / det + least)
    return Position(*_solve(sxx, sxy, syy, x, y), spread, slide=_solve(sxx, sxy, syy, ray_x, ray_y))


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


def _similarity_table(
    members: Indices,
    at: Position,
    poses: Floats,
    similarity: Floats,
    remaining: RemainingShifts,
    model: Model,
) -> Floats:
    """Log-likelihood (up to a constant) per direction from which the robot looks at the thing."""
    poses, similarity = poses[members], similarity[members]
    directions = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
    seen_from = np.arctan2(poses[:, 1] - at.y, poses[:, 0] - at.x)
    apart = np.cos(directions[:, None] - seen_from[None])
    expected = model.floor + model.side * np.exp(model.kappa * (apart - 1.0))
    error = np.minimum(similarity, model.usual_best)[None] - expected
    error, price = apply_remaining_shifts(error, remaining.subset(members), model)
    mean = error.mean(1)
    count = min(float(len(similarity)), model.independent)
    scatter = ((error - mean[:, None]) ** 2).mean(1) * (count / model.sigma_observation**2)
    offset = mean * mean / (model.sigma_instance**2 + model.sigma_observation**2 / count)
    offset = np.where(mean > 0, np.minimum(offset, model.too_similar), offset)
    degrees = min(len(similarity) - 1.0, model.independent)
    table: Floats = np.minimum(-0.5 * (scatter - 0.5 * degrees + offset) - price, 1.5)
    if float(similarity.max()) > model.usual_best + model.same_crop:
        table = table + model.same_crop_worth
    return table
