"""Landmarks: the things in the map that a crop may show, and what its box says beside each of them.

Where the map knows Objects with an estimate (fusion by evidence), a crop's matches are grouped by
Object, whose position and covariance count. All others are triangulated from the matches themselves
(`triangulation`).

What a box tells about the distance takes two quantities of a landmark, each the mean over the
observations whose boxes the picture's border does not cut there:

size        logarithm of the box's height in metres, log(height at 1 m) + log(distance)
elevation   of the upper or lower edge above the camera: rise of the line of sight × distance

Both rest on the estimated position, so an error of it is in them: they come with their gradient by
the position. A thing seen from one spot may stand half as far again, but then it is larger, too,
and looks from that spot as it did.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from projections.evidence import EvidenceConstants

from .appearance import DIRECTIONS, appearance_tables, relative
from .camera import LOWER, UPPER, Camera, Floats, Sights, sights, views
from .candidates import Match
from .constants import MapConstants
from .model import Model
from .question import Crop
from .sessions import subtract_shifts
from .triangulation import Triangulated, triangulate

Indices = NDArray[np.intp]

MAX_LANDMARKS: Final = 10
_MAX_OF_CLASS: Final = 96
_NEAREST_M: Final = 0.3
_PRIOR_EDGES: Final = 4.0
_SPOT_M: Final = 0.175
_RELEVANT_BELOW_BEST: Final = 0.15
_FULL_WEIGHT: Final = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Cue:
    """A quantity of n landmarks with its gradient by their position and its variance at a given
    position, infinite where nothing is known."""

    mean: Floats
    by_x: Floats
    by_y: Floats
    variance: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Of one crop. ``xy`` (n, 2) metres, ``spread`` (n, 3) the covariance xx, xy, yy in m².

    ``ratios`` (n, DIRECTIONS) are likelihood ratios by looks. ``seen_from`` (m, 2) are the
    positions from which they were seen, one landmark after the other from ``starts`` (n,) on.
    ``likeness`` (n,) is that of the most similar observation.
    """

    xy: Floats
    spread: Floats
    ratios: Floats
    size: Cue
    edges: tuple[Cue, Cue]
    seen_from: Floats
    starts: Indices
    likeness: Floats


@dataclass(frozen=True, slots=True, eq=False)
class CropEvidence:
    """A crop with its landmarks. ``bearing`` (radians, left positive) is None without a box;
    ``has_look`` is False where only the class is known."""

    landmarks: Landmarks
    bearing: float | None
    sight: Sights
    has_look: bool = True


def likeness_of(crop: Crop, row: Sequence[Match], constants: MapConstants) -> Floats:
    """Relative likenesses of a crop's matches; of a text with the map's shift added."""
    cosines = np.array([match.similarity for match in row], dtype=np.float64)
    if crop.is_text:
        cosines = np.minimum(cosines + constants.localizer.text_shift, 1.0)
    return relative(cosines, constants)


def crop_evidence(
    crop: Crop,
    row: Sequence[Match],
    likeness: Floats,
    shifts: Mapping[str, float],
    constants: MapConstants,
    camera: Camera,
    model: Model,
) -> CropEvidence | None:
    """The evidence of a crop; None if no match has a pose. ``likeness`` is of `likeness_of`."""
    posed = [index for index, match in enumerate(row) if match.pose is not None]
    if not posed:
        return None
    matches = [row[index] for index in posed]
    raw = likeness[posed]
    less = subtract_shifts(matches, raw, shifts)
    found = _landmarks(crop, matches, raw, less, constants, model)
    own = sights(camera, [crop.bbox])
    bearing = float(own.bearing[0]) if own.known[0] else None
    return CropEvidence(found, bearing, own, crop.vector is not None)


@dataclass(frozen=True, slots=True)
class _Thing:
    """A landmark's members, position and covariance."""

    members: Indices
    x: float
    y: float
    spread: tuple[float, float, float]


def _landmarks(
    crop: Crop,
    matches: Sequence[Match],
    raw: Floats,
    likeness: Floats,
    constants: MapConstants,
    model: Model,
) -> Landmarks:
    poses = np.array([match.pose for match in matches], dtype=np.float64)
    things = _things(crop, matches, poses, likeness, constants)
    members = np.concatenate([thing.members for thing in things])
    counts = [len(thing.members) for thing in things]
    starts = np.cumsum([0, *counts[:-1]])
    owner = np.repeat(np.arange(len(things)), counts)
    boxes = sights(constants.camera, [matches[i].bbox for i in members])
    poses, raw, likeness = poses[members], raw[members], likeness[members]
    xy = np.array([(thing.x, thing.y) for thing in things])
    sight = poses[:, 2] + boxes.bearing
    ratios = _ratios(crop, raw, likeness, sight, poses[:, 2], starts, constants, model)
    size, edges = _cues(boxes, poses, sight, xy[owner], starts, model)
    classes = [matches[thing.members[0]].class_name for thing in things]
    spots, of_spots = _spots(poses, owner)
    return Landmarks(
        xy,
        np.array([thing.spread for thing in things]),
        ratios,
        _with_class_sizes(size, classes, constants.evidence, model),
        edges,
        spots,
        of_spots,
        np.maximum.reduceat(raw, starts),
    )


def _things(
    crop: Crop,
    matches: Sequence[Match],
    poses: Floats,
    likeness: Floats,
    constants: MapConstants,
) -> list[_Thing]:
    """The landmarks, those with the most similar observation first."""
    by_object: dict[str, list[int]] = {}
    others: list[int] = []
    for index, match in enumerate(matches):
        if match.object_stand is None or match.object_id is None:
            others.append(index)
        else:
            by_object.setdefault(match.object_id, []).append(index)
    found = []
    for members in by_object.values():
        stand = matches[members[0]].object_stand
        if stand is not None:
            spread = (stand.xx, stand.xy, stand.yy)
            found.append(_Thing(np.array(members, dtype=np.intp), stand.x, stand.y, spread))
    most = MAX_LANDMARKS if crop.vector is not None else _MAX_OF_CLASS
    if others:
        found += _triangulated(matches, others, poses, likeness, constants, most)
    found.sort(key=lambda thing: (-float(likeness[thing.members].max()), int(thing.members[0])))
    return found[:most]


def _triangulated(
    matches: Sequence[Match],
    others: list[int],
    poses: Floats,
    likeness: Floats,
    constants: MapConstants,
    most: int,
) -> list[_Thing]:
    index = np.array(others, dtype=np.intp)
    alike = likeness[index]
    least = min(constants.evidence.same_class, float(alike.max()) - _RELEVANT_BELOW_BEST)
    index = index[alike >= least]
    weight = np.minimum(np.maximum((likeness[index] - least) / _FULL_WEIGHT, 0.1), 1.0)
    turned = poses[index] + (0.0, 0.0, constants.camera.yaw_rad)
    boxes = views(constants.camera, [matches[i].bbox for i in index])
    found: list[Triangulated] = triangulate(turned, boxes, weight, constants.evidence, most)
    return [_Thing(index[thing.members], thing.x, thing.y, thing.spread) for thing in found]


def _ratios(
    crop: Crop,
    raw: Floats,
    likeness: Floats,
    sight: Floats,
    heading: Floats,
    starts: Indices,
    constants: MapConstants,
    model: Model,
) -> Floats:
    if crop.vector is None:
        return np.full((len(starts), DIRECTIONS), math.exp(model.class_ratio))
    by_heading = constants.evidence.side_by == "heading"
    very = np.where(raw > model.same_picture, raw, likeness)
    tables = appearance_tables(very, heading if by_heading else sight, starts, constants, model)
    if crop.is_text:
        tables = model.text_weight * tables.mean(1, keepdims=True) + np.zeros(DIRECTIONS)
    ratios: Floats = np.exp(tables)
    return ratios


def _cues(
    boxes: Sights, poses: Floats, sight: Floats, at: Floats, starts: Indices, model: Model
) -> tuple[Cue, tuple[Cue, Cue]]:
    ux, uy = np.cos(sight), np.sin(sight)
    ahead = (at[:, 0] - poses[:, 0]) * ux + (at[:, 1] - poses[:, 1]) * uy
    ahead = np.maximum(ahead, _NEAREST_M)
    per = 1.0 / ahead
    tall = boxes.tall.astype(np.float64)
    size, _, count = _mean_cue(boxes.log_height + np.log(ahead), ux * per, uy * per, tall, starts)
    size = Cue(
        size.mean, size.by_x, size.by_y, np.where(count > 0.0, model.size_spread**2, math.inf)
    )
    edges = []
    for edge in (UPPER, LOWER):
        rise, whole = boxes.rise[edge], boxes.whole[edge].astype(np.float64)
        cue, scatter, count = _mean_cue(rise * ahead, rise * ux, rise * uy, whole, starts)
        part = model.edge_part * cue.mean
        prior = _PRIOR_EDGES * (model.edge_m**2 + part * part)
        variance = np.where(count > 0.0, (scatter + prior) / (count + _PRIOR_EDGES), math.inf)
        edges.append(Cue(cue.mean, cue.by_x, cue.by_y, variance))
    return size, (edges[0], edges[1])


def _mean_cue(
    value: Floats, by_x: Floats, by_y: Floats, weight: Floats, starts: Indices
) -> tuple[Cue, Floats, Floats]:
    """Weighted means over each landmark's observations, the sum of squared deviations, and the
    weight; the variance is left 0."""
    count = np.add.reduceat(weight, starts)
    safe = np.maximum(count, 1e-9)
    rows = np.stack((value, value * value, by_x, by_y)) * weight
    mean, square, x, y = np.add.reduceat(rows, starts, axis=1) / safe
    scatter = np.maximum(square - mean * mean, 0.0) * count
    return Cue(mean, x, y, np.zeros_like(mean)), scatter, count


def _with_class_sizes(
    size: Cue, classes: Sequence[str], evidence: EvidenceConstants, model: Model
) -> Cue:
    """Where no box of a landmark has a height, the size of its class, if that is known."""
    mean, variance = size.mean.copy(), size.variance.copy()
    for index in np.flatnonzero(~np.isfinite(variance)).tolist():
        height = evidence.sizes_m.get(classes[index])
        if height is not None:
            mean[index] = math.log(height)
            variance[index] = evidence.size_spread**2 + model.size_spread**2
    return Cue(mean, size.by_x, size.by_y, variance)


def _spots(poses: Floats, owner: Indices) -> tuple[Floats, Indices]:
    """Where each landmark was seen from, to 0.18 m, and where each landmark's begin."""
    x, y = np.rint(poses[:, :2].T / _SPOT_M)
    order = np.lexsort((y, x, owner))
    x, y, owner = x[order], y[order], owner[order]
    is_new = np.ones(len(owner), dtype=np.bool_)
    is_new[1:] = (np.diff(owner) != 0) | (np.diff(x) != 0) | (np.diff(y) != 0)
    starts = np.searchsorted(owner[is_new], np.arange(int(owner[-1]) + 1))
    spots: Floats = np.column_stack((x, y))[is_new] * _SPOT_M
    return spots, starts.astype(np.intp)
