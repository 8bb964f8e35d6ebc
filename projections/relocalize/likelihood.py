"""Likelihood of a crop at a pose: a mixture of its landmarks, and of none of them.

For a robot at a pose the crop's likelihood, as a ratio against a thing that the map lacks, is

    (1 − k) + k · share · Σ  looks · seen_from · (box + tail · in_front)
                       landmarks

looks       ratio by appearance, from the direction in which the robot looks (`appearance`)
seen_from   exp(−d² / 2 σ²), d the distance from the nearest position that saw the landmark; less
            where a wall of the occupancy map is between
box         ratio by the bearing of the box's middle, and by its height and edges (`landmarks`);
            without a box, by the usual distance and whether the landmark is in the field of view
in_front    1 if the landmark is in the field of view and within twice the usual distance

The last term is a heavy tail: what looks like a landmark and is near where that was seen counts
whatever the box says, as the plain method has it. k is below 1, so one unknown or wrong crop does
not outvote the others.

Errors of the landmark's position, of the pose and of the box add up; all are linearised. The
position's part is computed once for many headings (`Terms`).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .appearance import DIRECTIONS
from .camera import LOWER, UPPER, Camera, Floats
from .constants import MapConstants
from .landmarks import CropEvidence, Cue
from .model import Model
from .walls import Walls

Indices = NDArray[np.intp]

_TURN: Final = 2.0 * math.pi
_NEAREST_M2: Final = 0.09
_MOST_BY_SIZE: Final = 6.0
_MOST_BY_EDGE: Final = 4.0
_MOST_CHI2: Final = 40.0
_LEAST_LOOKS: Final = 0.02
"""Part of the largest from which it is worth to look whether a wall is between."""
_ROUGH_BEARING: Final = 0.05
"""Variance added to bearings where no heading is considered."""


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Of n landmarks and h positions, arrays (n, h): ``looks`` times seen_from, ``box`` without the
    bearing, ``towards`` the direction to the landmark in the map and ``variance`` of its bearing,
    ``near`` whether it is within twice the usual distance."""

    looks: Floats
    box: Floats
    towards: Floats
    variance: Floats
    near: NDArray[np.bool_]

    def take(self, index: Indices) -> "Terms":
        """Those of the positions at ``index``."""
        return Terms(
            self.looks.take(index, axis=1),
            self.box.take(index, axis=1),
            self.towards.take(index, axis=1),
            self.variance.take(index, axis=1),
            self.near.take(index, axis=1),
        )


@dataclass(frozen=True, slots=True)
class Scene:
    """What all crops of a question share: the map's constants, the asking camera, parameters."""

    constants: MapConstants
    camera: Camera
    model: Model
    walls: Walls | None = None


def terms_at(crop: CropEvidence, xy: Floats, error_m2: float, scene: Scene) -> Terms:
    """The terms at positions ``xy`` (h, 2) that have the variance ``error_m2`` in each direction,
    beside that of every pose."""
    marks, evidence, model = crop.landmarks, scene.constants.evidence, scene.model
    pose_m2 = model.pose_m**2 + error_m2
    dx = marks.xy[:, 0, None] - xy[None, :, 0]
    dy = marks.xy[:, 1, None] - xy[None, :, 1]
    square = np.maximum(dx * dx + dy * dy, _NEAREST_M2)
    reach = np.sqrt(square)
    towards = np.arctan2(dy, dx)
    ux, uy = dx / reach, dy / reach
    xx, xy_, yy = (marks.spread[:, i, None] for i in range(3))
    across = (xx * uy * uy - 2.0 * xy_ * ux * uy + yy * ux * ux + pose_m2) / square
    bearing = evidence.bearing_cut_rad if crop.sight.cut[0] else evidence.bearing_rad
    seen = -0.5 * _nearest(marks.seen_from, marks.starts, xy) / (model.seen_from_m**2 + error_m2)
    if crop.bearing is None:
        off = (np.log(reach) - math.log(evidence.range_m)) / evidence.range_spread
        box = np.maximum(-0.5 * off * off, -_MOST_BY_SIZE)
    else:
        box = np.zeros_like(reach)
        offset = (ux, uy, reach, pose_m2, (xx, xy_, yy))
        box += _by_size(crop, offset, model)
        for edge in (UPPER, LOWER):
            if crop.sight.whole[edge, 0]:
                box += _by_edge(marks.edges[edge], float(crop.sight.rise[edge, 0]), offset, model)
    looks = _ratio_towards(crop, towards, scene) * np.exp(seen)
    if scene.walls is not None:
        counts = looks > _LEAST_LOOKS * looks.max(initial=0.0)
        looks[scene.walls.hides(marks.xy, xy, counts)] *= model.through_walls
    return Terms(
        looks,
        np.exp(box),
        towards,
        across + bearing * bearing,
        reach < model.twice * evidence.range_m,
    )


_Offset = tuple[Floats, Floats, Floats, float, tuple[Floats, Floats, Floats]]


def _nearest(points: Floats, starts: Indices, xy: Floats) -> Floats:
    """Squared distances of each position to the nearest of each landmark's points."""
    dx = points[:, 0, None] - xy[None, :, 0]
    dy = points[:, 1, None] - xy[None, :, 1]
    squared: Floats = np.minimum.reduceat(dx * dx + dy * dy, starts, axis=0)
    return squared


def _ratio_towards(crop: CropEvidence, towards: Floats, scene: Scene) -> Floats:
    """The ratios by looks, between two directions of the table in proportion."""
    by_heading = scene.constants.evidence.side_by == "heading" and crop.bearing is not None
    turned = towards - (crop.bearing or 0.0) if by_heading else towards
    place = turned * (DIRECTIONS / _TURN)
    low = np.floor(place)
    part = place - low
    row = np.arange(len(towards))[:, None] * DIRECTIONS
    flat = crop.landmarks.ratios.ravel()
    first = low.astype(np.intp) % DIRECTIONS
    second = np.where(first == DIRECTIONS - 1, 0, first + 1)
    ratios: Floats = flat.take(row + first) * (1.0 - part) + flat.take(row + second) * part
    return ratios


def _by_size(crop: CropEvidence, offset: _Offset, model: Model) -> Floats:
    """By the box's height; by a cut box's only whether the thing is too far away for it."""
    ux, uy, reach, pose_m2, spread = offset
    size = crop.landmarks.size
    per = 1.0 / reach
    known = np.isfinite(size.variance)[:, None]
    own = np.where(np.isfinite(size.variance), size.variance, 1.0)[:, None]
    variance = _variance(size.by_x[:, None] - ux * per, size.by_y[:, None] - uy * per, spread)
    variance += own + pose_m2 * per * per
    # how much taller it should be than the box
    taller = size.mean[:, None] - float(crop.sight.log_height[0]) - np.log(reach)
    if not crop.sight.tall[0]:
        shorter = np.minimum(taller, 0.0)
        fit = np.maximum(-0.5 * shorter * shorter / variance, -_MOST_BY_EDGE)
    else:
        fit = _gain(taller, variance, model.other_sizes**2, _MOST_BY_SIZE)
    return np.where(known, fit, 0.0)


def _by_edge(edge: Cue, rise: float, offset: _Offset, model: Model) -> Floats:
    ux, uy, reach, pose_m2, spread = offset
    per = 1.0 / reach
    known = np.isfinite(edge.variance)[:, None]
    own = np.where(np.isfinite(edge.variance), edge.variance, 1.0)[:, None]
    expected = edge.mean[:, None] * per
    gx = (edge.by_x[:, None] - expected * ux) * per
    gy = (edge.by_y[:, None] - expected * uy) * per
    variance = _variance(gx, gy, spread)
    variance += (own + expected * expected * pose_m2) * per * per + model.edge_rise**2
    fit = _gain(rise - expected, variance, model.other_rises**2, _MOST_BY_EDGE)
    return np.where(known, fit, 0.0)


def _variance(gx: Floats, gy: Floats, spread: tuple[Floats, Floats, Floats]) -> Floats:
    xx, xy, yy = spread
    found: Floats = gx * (gx * xx + 2.0 * gy * xy) + gy * gy * yy
    return found


def _gain(off: Floats, variance: Floats, other: float, most: float) -> Floats:
    """Log ratio of the normal density of ``off`` to that of other things."""
    wide = variance + other
    chi = off * off
    fit = -0.5 * (chi * (1.0 / variance - 1.0 / wide) + np.log(variance / wide))
    return np.minimum(np.maximum(fit, -most), most)


def log_likelihood(
    crop: CropEvidence, terms: Terms, yaw: Floats, yaw_variance: float, scene: Scene
) -> Floats:
    """Logarithm of the mixture at h poses: the terms' positions with ``yaw`` (h,)."""
    half = scene.camera.half_field_rad
    middle = scene.camera.yaw_rad
    if crop.bearing is None:
        ahead = np.abs(_wrap(terms.towards - (yaw + middle))) < half
        return _mixture(terms, ahead * terms.box + scene.model.tail * (ahead & terms.near), scene)
    off = _wrap(terms.towards - (yaw + crop.bearing))
    variance = terms.variance + yaw_variance
    chi = np.minimum(off * off / variance, _MOST_CHI2)
    fit = np.exp(-0.5 * chi) * (2.0 * half) / np.sqrt(_TURN * variance)
    in_front = (np.abs(off) < half) & terms.near
    return _mixture(terms, fit * terms.box + scene.model.tail * in_front, scene)


def log_likelihood_of_place(crop: CropEvidence, terms: Terms, scene: Scene) -> Floats:
    """About the logarithm of the mixture at the best heading, for h positions."""
    rough: Floats = np.ones(1)
    if crop.bearing is not None:
        wide = terms.variance + _ROUGH_BEARING
        rough = 2.0 * scene.camera.half_field_rad / np.sqrt(_TURN * wide)
    return _mixture(terms, rough * terms.box + scene.model.tail * terms.near, scene)


def log_likelihood_unaimed(terms: Terms, scene: Scene) -> Floats:
    """About the logarithm of the mixture at headings that no landmark's bearing fits."""
    in_view = scene.camera.half_field_rad / math.pi
    tail: Floats = scene.model.tail * in_view * terms.near.astype(np.float64)
    return _mixture(terms, tail, scene)


def _mixture(terms: Terms, fit: Floats, scene: Scene) -> Floats:
    model = scene.model
    total = (terms.looks * fit).sum(0)
    found: Floats = np.log((1.0 - model.in_map) + (model.in_map * model.share) * total)
    return found


def _wrap(angle: Floats) -> Floats:
    return angle - _TURN * np.rint(angle / _TURN)


def headings(crop: CropEvidence, terms: Terms, scene: Scene) -> tuple[Floats, Floats, Floats]:
    """For each landmark and position the heading that puts the landmark where the crop shows it,
    its variance, and how likely it is, up to a factor that all crops share."""
    half, variance = scene.camera.half_field_rad, terms.variance
    if crop.bearing is None:
        variance = np.full_like(variance, (0.5 * half) ** 2)
        bearing = scene.camera.yaw_rad
    else:
        bearing = crop.bearing
    return terms.towards - bearing, variance, terms.looks * terms.box / np.sqrt(variance)


def unexplained(model: Model) -> float:
    """The log-likelihood of a crop without evidence: its thing is not in the map."""
    return math.log(1.0 - model.in_map)
