"""Likelihood of a crop at a pose: a mixture of its landmarks, and of none of them.

For a robot at a pose the crop's likelihood, as a ratio to that of a thing that the map lacks, is

    (1 − k) + k · share · Σ  looks · seen_from · (box + tail · in_front)
                       landmarks

looks       ratio by appearance, from the direction in which the robot looks (`appearance`)
seen_from   exp(−d² / 2 σ²), d the distance from the nearest position that saw the landmark; less
            where a wall of the occupancy map is between
box         ratio by the bearing of the box's middle, and by its height and edges (`landmarks`);
            without a box, by the usual distance and whether the landmark is in the field of view
in_front    1 if the landmark is in the field of view and within twice the usual distance

The last term is a heavy tail: a crop that looks like a landmark counts near where that was seen
even if its box contradicts, as in the plain baseline. k is below 1, so one unknown or wrong crop
does not outvote the others.

Errors of the landmark's position, of the pose and of the box add up; all are linearised. The
position's part is computed once for many headings (`Terms`), and for all crops of a group at once.
Landmarks that were seen from so far away that they add nothing are left out where that saves time.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from projections.fold.settings import CameraConstants

from .appearance import DIRECTIONS
from .camera import Floats, half_field_rad
from .constants import MapConstants, RankingModel
from .ground import WallLookup
from .landmarks import CropGroup

Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

_TURN: Final = 2.0 * math.pi
_NEAREST_M2: Final = 0.09
_MOST_BY_SIZE: Final = 6.0
_MOST_BY_EDGE: Final = 4.0
_MOST_CHI2: Final = 40.0
_LEAST_LOOKS: Final = 0.02
"""Share of the largest ``looks`` from which walls in between are looked for."""
_ROUGH_BEARING: Final = 0.05
"""Variance added to bearings where no heading is given."""
_FAR: Final = 120.0
"""χ² of the distance to where a landmark was seen from: beyond it, seen_from is below 1e-26."""
_LEAST_PART: Final = 1e-24
"""``looks`` times seen_from below which a landmark does not change the mixture."""
_MANY: Final = 4_000
"""Number of pairs of landmark and position from which leaving such landmarks out saves time."""


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Factors of the likelihood for pairs of a landmark and a position, arrays of one shape:
    ``looks``, already times seen_from; ``box`` without the bearing; ``heading``, at which the
    landmark is where the crop shows it (without a box: in the middle of the picture); ``variance``
    of its bearing (without a box: of the heading); ``near``, whether it is within twice the usual
    distance.

    The shape is (n, h) for all pairs of n landmarks and h positions, or one axis for some of them.
    ``slot`` is the number of the landmark's crop times h, plus that of the position.
    """

    looks: Floats
    box: Floats
    heading: Floats
    variance: Floats
    near: Flags
    slot: Indices
    crops: int
    positions: int

    def take(self, index: Indices) -> "Terms":
        """The terms at the positions ``index``; only for terms of all pairs."""
        slot = self.slot[:, :1] // self.positions * len(index) + np.arange(len(index))
        return self._at(lambda values: values.take(index, axis=1), slot, len(index))

    def relevant(self) -> "Terms":
        """The terms without pairs that do not change the mixture; all of them if there are few."""
        if self.looks.size < _MANY:
            return self
        index = np.flatnonzero(self.looks > _LEAST_PART)
        slot = self.slot.ravel().take(index)
        return self._at(lambda values: values.ravel().take(index), slot, self.positions)

    def _at(self, part: Callable[[Any], Any], slot: Indices, positions: int) -> "Terms":
        return Terms(
            part(self.looks),
            part(self.box),
            part(self.heading),
            part(self.variance),
            part(self.near),
            slot,
            self.crops,
            positions,
        )


@dataclass(frozen=True, slots=True)
class Scene:
    """Values that all crops of a question share: the map's constants, and the question's camera,
    parameters and walls."""

    constants: MapConstants
    camera: CameraConstants
    model: RankingModel
    walls: WallLookup | None = None


class _Pairs:
    """Pairs of a landmark and a position: all, or only near ones."""

    def __init__(self, group: CropGroup, xy: Floats, reach_m: float | None) -> None:
        marks = group.landmarks
        owner = group.owner
        self._marks: Indices | None = None
        if reach_m is None or len(owner) * len(xy) < _MANY:
            self.x, self.y = xy[None, :, 0], xy[None, :, 1]
            self.slot = owner[:, None] * len(xy) + np.arange(len(xy))
            self.row = np.arange(len(owner))[:, None]
        else:
            self._marks, places = _near_pairs(marks.seen_from, marks.starts, xy, reach_m)
            self.x, self.y = xy[:, 0].take(places), xy[:, 1].take(places)
            self.slot = owner.take(self._marks) * len(xy) + places
            self.row = self._marks

    def of(self, values: Any) -> Any:
        """A quantity of the landmarks (last axis) for each pair."""
        return values[..., None] if self._marks is None else values.take(self._marks, axis=-1)

    def nearest(self, points: Floats, starts: Indices) -> Floats:
        """Squared distance of each pair's position to the nearest of its landmark's points."""
        if self._marks is None:
            dx, dy = points[:, 0, None] - self.x, points[:, 1, None] - self.y
            squared: Floats = np.minimum.reduceat(dx * dx + dy * dy, starts, axis=0)
            return squared
        if not len(self._marks):
            return np.zeros(0)
        counts = np.diff(starts, append=len(points)).take(self._marks)
        begin = np.cumsum(counts) - counts
        which = np.arange(int(counts.sum())) + (starts.take(self._marks) - begin).repeat(counts)
        dx = points[:, 0].take(which) - self.x.repeat(counts)
        dy = points[:, 1].take(which) - self.y.repeat(counts)
        nearest: Floats = np.minimum.reduceat(dx * dx + dy * dy, begin)
        return nearest


def _near_pairs(
    points: Floats, starts: Indices, xy: Floats, reach_m: float
) -> tuple[Indices, Indices]:
    """Landmark and position of the pairs where the position is in the rectangle around the
    landmark's points, larger by ``reach_m`` on each side."""
    least = np.minimum.reduceat(points, starts, axis=0) - reach_m
    most = np.maximum.reduceat(points, starts, axis=0) + reach_m
    order = np.argsort(xy[:, 0], kind="stable")
    ordered = xy[:, 0].take(order)
    begin = np.searchsorted(ordered, least[:, 0])
    counts = np.searchsorted(ordered, most[:, 0], side="right") - begin
    marks = np.arange(len(starts)).repeat(counts)
    places = np.arange(len(marks)) + (begin - np.cumsum(counts) + counts).repeat(counts)
    places = order.take(places)
    y = xy[:, 1].take(places)
    near = np.flatnonzero((y >= least[:, 1].take(marks)) & (y <= most[:, 1].take(marks)))
    return marks.take(near), places.take(near)


def terms_at(
    group: CropGroup, xy: Floats, error_m2: float, scene: Scene, *, every: bool = False
) -> Terms:
    """The terms at positions ``xy`` (h, 2) that have the variance ``error_m2`` in each direction,
    added to that of every pose; with ``every`` for all pairs, also those that do not change the
    mixture."""
    marks, evidence, model = group.landmarks, scene.constants.evidence, scene.model
    pose_m2 = model.pose_m**2 + error_m2
    seen_m2 = model.seen_from_m**2 + error_m2
    far = None if every else math.sqrt(_FAR * seen_m2)
    pairs = _Pairs(group, xy, far)
    x, y = pairs.of(marks.xy.T)
    dx, dy = x - pairs.x, y - pairs.y
    square = np.maximum(dx * dx + dy * dy, _NEAREST_M2)
    reach = np.sqrt(square)
    towards = np.arctan2(dy, dx)
    seen = -0.5 * pairs.nearest(marks.seen_from, marks.starts) / seen_m2
    log_reach = np.log(reach)
    if group.boxed:
        per = 1.0 / reach
        ux, uy = dx * per, dy * per
        xx, xy_, yy = spread = tuple(pairs.of(marks.spread.T))
        across = (xx * uy * uy - 2.0 * xy_ * ux * uy + yy * ux * ux + pose_m2) / square
        bearing = np.where(group.sight.cut, evidence.bearing_cut_rad, evidence.bearing_rad)
        variance = across + pairs.of((bearing * bearing).take(group.owner))
        offset = _Offset(ux, uy, per, log_reach, pose_m2, spread)
        box = _by_size(group, pairs, offset, model) + _by_edges(group, pairs, offset, model)
        heading = towards - pairs.of(group.sight.bearing.take(group.owner))
    else:
        off = (log_reach - math.log(evidence.range_m)) / evidence.range_spread
        box = np.maximum(-0.5 * off * off, -_MOST_BY_SIZE)
        variance = np.full_like(box, (0.5 * half_field_rad(scene.camera)) ** 2)
        heading = towards - scene.camera.yaw_rad
    by_heading = evidence.side_by == "heading" and group.boxed
    looks = _ratio_towards(marks.ratios, pairs.row, heading if by_heading else towards)
    looks *= np.exp(seen)
    if scene.walls is not None:
        looks[_hidden(group, pairs, xy, looks, scene.walls)] *= model.through_walls
    return Terms(
        looks,
        np.exp(box),
        heading,
        variance,
        reach < model.twice * evidence.range_m,
        pairs.slot,
        len(group.first),
        len(xy),
    )


def _hidden(group: CropGroup, pairs: _Pairs, xy: Floats, looks: Floats, walls: WallLookup) -> Flags:
    """Flags of the pairs that have a wall in between; False, unchecked, where the landmark looks
    little like the crop."""
    crop, place = np.divmod(pairs.slot, len(xy))
    most = np.zeros(len(group.first))
    np.maximum.at(most, crop, looks)
    asked = np.zeros((len(group.owner), len(xy)), dtype=np.bool_)
    asked[pairs.row, place] = looks > _LEAST_LOOKS * most.take(crop)
    found: Flags = walls.hides(group.landmarks.xy, xy, asked)[pairs.row, place]
    return found


class _Offset(NamedTuple):
    """Landmarks relative to positions: unit vector, inverse and logarithm of the distance, the
    variance of the position and the covariance of the landmark."""

    ux: Floats
    uy: Floats
    per: Floats
    log_reach: Floats
    pose_m2: float
    spread: tuple[Floats, ...]


def _ratio_towards(ratios: Floats, row: Indices, towards: Floats) -> Floats:
    """The ratios by looks, interpolated linearly between directions of the table."""
    place = towards * (DIRECTIONS / _TURN)
    low = np.floor(place)
    part = place - low
    low -= DIRECTIONS * np.floor(low / DIRECTIONS)
    row_of = DIRECTIONS + 1
    around = np.concatenate((ratios, ratios[:, :1]), axis=1).ravel()
    first = row * row_of + low.astype(np.intp)
    found: Floats = around.take(first) * (1.0 - part) + around.take(first + 1) * part
    return found


def _by_size(group: CropGroup, pairs: _Pairs, offset: _Offset, model: RankingModel) -> Floats:
    """The log ratio by the box's height; a cut box is only evidence against things too far away for
    it."""
    size, per = group.landmarks.size, offset.per
    known = np.isfinite(size.variance)
    own = np.where(known, size.variance, 1.0)
    by_x, by_y = pairs.of(size.by_x) - offset.ux * per, pairs.of(size.by_y) - offset.uy * per
    variance = _variance(by_x, by_y, offset.spread)
    variance += pairs.of(own) + offset.pose_m2 * per * per
    # how much taller it should be than the box
    height = group.sight.log_height.take(group.owner)
    taller = pairs.of(size.mean - height) - offset.log_reach
    tall = group.sight.tall.take(group.owner)
    fit: Floats = np.zeros(1)
    if not tall.all():
        shorter = np.minimum(taller, 0.0)
        fit = np.maximum(-0.5 * shorter * shorter / variance, -_MOST_BY_EDGE)
    if tall.any():
        gain = _gain(taller, variance, model.other_sizes**2, _MOST_BY_SIZE)
        fit = np.where(pairs.of(tall), gain, fit)
    return np.where(pairs.of(known), fit, 0.0)


def _by_edges(group: CropGroup, pairs: _Pairs, offset: _Offset, model: RankingModel) -> Any:
    """The log ratio by the upper and the lower edge, where the picture's border does not cut
    them."""
    edges, per = group.edges, offset.per
    counts = np.isfinite(edges.variance) & group.sight.whole.take(group.owner, axis=1)
    if not counts.any():
        return 0.0
    own = np.where(counts, edges.variance, 1.0)
    expected = pairs.of(edges.mean) * per
    gx = (pairs.of(edges.by_x) - expected * offset.ux) * per
    gy = (pairs.of(edges.by_y) - expected * offset.uy) * per
    variance = _variance(gx, gy, offset.spread)
    variance += (pairs.of(own) + expected * expected * offset.pose_m2) * (per * per)
    variance += model.edge_rise**2
    rise = pairs.of(group.sight.rise.take(group.owner, axis=1))
    fit = _gain(rise - expected, variance, model.other_rises**2, _MOST_BY_EDGE)
    return np.where(pairs.of(counts), fit, 0.0).sum(0)


def _variance(gx: Floats, gy: Floats, spread: tuple[Floats, ...]) -> Floats:
    xx, xy, yy = spread
    found: Floats = gx * (gx * xx + 2.0 * gy * xy) + gy * gy * yy
    return found


def _gain(off: Floats, variance: Floats, other: float, most: float) -> Floats:
    """Log ratio of the normal density of ``off`` to that of other things."""
    wide = variance + other
    fit = -0.5 * (off * off * (1.0 / variance - 1.0 / wide) + np.log(variance / wide))
    return np.minimum(np.maximum(fit, -most), most)


def log_likelihood(
    group: CropGroup, terms: Terms, yaw: Floats, yaw_variance: float, scene: Scene
) -> Floats:
    """Log-likelihoods of the crops, shape (c, k, h), at the terms' positions with the headings
    ``yaw`` (k, h)."""
    half = half_field_rad(scene.camera)
    at = yaw[:, None] if terms.looks.ndim == 2 else yaw.take(terms.slot % terms.positions, axis=1)
    off = terms.heading - at
    off -= _TURN * np.rint(off / _TURN)
    fit = (np.abs(off) < half) * (
        scene.model.tail * terms.near + (0.0 if group.boxed else terms.box)
    )
    if group.boxed:
        variance = terms.variance + yaw_variance
        chi = np.minimum(off * off / variance, _MOST_CHI2)
        fit += np.exp(-0.5 * chi) * (terms.box * (2.0 * half) / np.sqrt(_TURN * variance))
    found: Floats = _mixture(terms, fit, scene).swapaxes(0, 1)
    return found


def log_likelihood_of_place(group: CropGroup, terms: Terms, scene: Scene) -> Floats:
    """Approximate log-likelihoods of the crops at the best heading, shape (c, h)."""
    fit: Any = terms.box
    if group.boxed:
        wide = terms.variance + _ROUGH_BEARING
        fit = fit * (2.0 * half_field_rad(scene.camera) / np.sqrt(_TURN * wide))
    found: Floats = _mixture(terms, fit + scene.model.tail * terms.near, scene)[0]
    return found


def log_likelihood_unaimed(terms: Terms, scene: Scene) -> Floats:
    """Approximate log-likelihoods of the crops at headings that fit no landmark's bearing, shape
    (c, h)."""
    in_view = half_field_rad(scene.camera) / math.pi
    tail: Floats = terms.near.astype(np.float64) * (scene.model.tail * in_view)
    found: Floats = _mixture(terms, tail, scene)[0]
    return found


def _mixture(terms: Terms, fit: Floats, scene: Scene) -> Floats:
    """The logarithms of the mixtures, shape (k, c, h); ``fit`` has the shape of the terms, or one
    axis of k more."""
    model, parts, count = scene.model, terms.looks * fit, terms.crops * terms.positions
    slot, times = terms.slot, 1
    if parts.ndim > slot.ndim:
        times = len(parts)
        slot = slot[None] + (np.arange(times) * count).reshape(-1, *(1,) * slot.ndim)
    total = np.bincount(slot.ravel(), parts.ravel(), times * count)
    found: Floats = np.log((1.0 - model.in_map) + (model.in_map * model.share) * total)
    return found.reshape(times, terms.crops, terms.positions)


def headings(terms: Terms) -> tuple[Floats, Floats, Floats]:
    """For each landmark and position the heading that puts the landmark where the crop shows it,
    its variance, and how likely it is, up to a factor that all crops share."""
    return terms.heading, terms.variance, terms.looks * terms.box / np.sqrt(terms.variance)
