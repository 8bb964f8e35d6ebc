"""Landmarks: the things in the map that a crop may show, and the cues to compare its box with.

Where the map knows Objects with an estimate (fusion by evidence), a crop's matches are grouped by
Object, whose position and covariance count. All others are triangulated from the matches themselves
(`triangulation`).
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from projections.fold.settings import CameraConstants

from .appearance import DIRECTIONS, appearance_tables, relative, subtract_shifts
from .camera import (
    Cameras,
    Cue,
    Floats,
    SightLines,
    box_rows,
    camera_values,
    cues,
    sights,
    views,
    with_class_sizes,
)
from .candidates import Match, ObjectEstimate
from .constants import MapConstants, RankingModel
from .question import QuestionCrop
from .triangulation import Triangulated, triangulate

Indices = NDArray[np.intp]

MAX_LANDMARKS: Final = 10
_MAX_OF_CLASS: Final = 96
_SPOT_M: Final = 0.175
_RELEVANT_BELOW_BEST: Final = 0.15
_FULL_WEIGHT: Final = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """The n landmarks of crops. ``xy`` (n, 2) in metres, ``spread`` (n, 3) the covariance xx, xy,
    yy in m².

    ``ratios`` (n, DIRECTIONS) are likelihood ratios by looks. ``seen_from`` (m, 2) are the
    positions from which they were seen, one landmark after the other from ``starts`` (n,) on.
    ``likeness`` (n,) is the likeness of the most similar observation.
    """

    xy: Floats
    spread: Floats
    ratios: Floats
    size: Cue
    edges: tuple[Cue, Cue]
    seen_from: Floats
    starts: Indices
    likeness: Floats

    def part(self, start: int, end: int) -> "Landmarks":
        """The landmarks from ``start`` to before ``end``."""
        rows = slice(start, end)
        begin = int(self.starts[start])
        stop = int(self.starts[end]) if end < len(self.starts) else len(self.seen_from)
        return Landmarks(
            self.xy[rows],
            self.spread[rows],
            self.ratios[rows],
            self.size.part(rows),
            (self.edges[0].part(rows), self.edges[1].part(rows)),
            self.seen_from[begin:stop],
            self.starts[rows] - begin,
            self.likeness[rows],
        )


@dataclass(frozen=True, slots=True, eq=False)
class CropGroup:
    """Crops of one view that all have a box, or all have none, and their landmarks, grouped by
    crop; ``first`` (c,) has the index of each crop's first. ``has_embedding`` (c,) is False where
    only the class is known."""

    landmarks: Landmarks
    first: Indices
    sight: SightLines
    has_embedding: tuple[bool, ...]
    owner: Indices = field(init=False)
    """The index of each landmark's crop."""
    edges: Cue = field(init=False)
    """The edges of the landmarks, as arrays (2, n)."""

    def __post_init__(self) -> None:
        counts = np.diff(self.first, append=len(self.landmarks.xy))
        object.__setattr__(self, "owner", np.arange(len(counts)).repeat(counts))
        one, two = self.landmarks.edges
        both = Cue(
            np.array((one.mean, two.mean)),
            np.array((one.by_x, two.by_x)),
            np.array((one.by_y, two.by_y)),
            np.array((one.variance, two.variance)),
        )
        object.__setattr__(self, "edges", both)

    @property
    def boxed(self) -> bool:
        """Whether its crops have boxes."""
        return bool(self.sight.known[0])

    def of_each(self) -> list[Landmarks]:
        """The landmarks of each crop."""
        ends = [*self.first[1:].tolist(), len(self.landmarks.xy)]
        return [
            self.landmarks.part(start, end)
            for start, end in zip(self.first.tolist(), ends, strict=True)
        ]


def likeness_of(crop: QuestionCrop, row: Sequence[Match], constants: MapConstants) -> Floats:
    """Relative likenesses of a crop's matches; those of a text have the map's shift added."""
    cosines = np.array([match.similarity for match in row], dtype=np.float64)
    if crop.is_text:
        cosines = np.minimum(cosines + constants.localizer.text_shift, 1.0)
    return relative(cosines, constants)


class Seen(NamedTuple):
    """A crop, its matches that have a pose, and their relative likenesses: ``raw``, and with the
    shifts of their runs subtracted."""

    crop: QuestionCrop
    matches: Sequence[Match]
    raw: Floats
    likeness: Floats

    @classmethod
    def of(
        cls, crop: QuestionCrop, row: Sequence[Match], likeness: Floats, shifts: Mapping[str, float]
    ) -> "Seen | None":
        """The crop with its posed matches; None if no match has a pose. ``likeness`` is of
        `likeness_of`."""
        matches = [match for match in row if match.pose is not None]
        if not matches:
            return None
        if len(matches) < len(row):
            likeness = likeness[[match.pose is not None for match in row]]
        return cls(crop, matches, likeness, subtract_shifts(matches, likeness, shifts))


def crop_groups(
    views_seen: Sequence[Sequence[Seen]],
    constants: MapConstants,
    camera: CameraConstants,
    model: RankingModel,
) -> list[list[CropGroup]]:
    """The evidence of the crops of each view, in two groups at most; there is at least one crop.

    Most is computed for all crops at once, because an array operation takes a microsecond or more
    even for few numbers.
    """
    seen = [each for view in views_seen for each in view]
    view_of = [number for number, view in enumerate(views_seen) for _ in view]
    boxes = sights(Cameras.of([camera_values(camera)]), box_rows([each.crop.bbox for each in seen]))
    known = boxes.known.tolist()
    order = sorted(range(len(seen)), key=lambda crop: (view_of[crop], not known[crop]))
    seen, boxes = [seen[crop] for crop in order], boxes.take(np.array(order))
    marks, first = _landmarks(seen, constants, model)
    found: list[list[CropGroup]] = [[] for _ in views_seen]
    begin = 0
    for (view, _), crops in itertools.groupby(order, lambda crop: (view_of[crop], known[crop])):
        end = begin + len(list(crops))
        part = marks.part(int(first[begin]), int(first[end]))
        looks = tuple(each.crop.vector is not None for each in seen[begin:end])
        within = first[begin:end] - first[begin]
        found[view].append(CropGroup(part, within, boxes.take(slice(begin, end)), looks))
        begin = end
    return found


@dataclass(frozen=True, slots=True)
class _Thing:
    """A landmark's members, position and covariance."""

    members: Indices
    x: float
    y: float
    spread: tuple[float, float, float]


def _landmarks(
    seen: Sequence[Seen], constants: MapConstants, model: RankingModel
) -> tuple[Landmarks, Indices]:
    """The landmarks of all crops, and the index of each crop's first one, with the total at the
    end."""
    matches = [match for each in seen for match in each.matches]
    begins = np.cumsum([0, *(len(each.matches) for each in seen[:-1])])
    poses = np.array([match.pose for match in matches], dtype=np.float64)
    rows = box_rows([match.bbox for match in matches])
    otherwise = camera_values(constants.camera)
    cameras = Cameras.of([match.camera or otherwise for match in matches])
    likeness = np.concatenate([each.likeness for each in seen])
    of_crops = _things(seen, begins, poses, rows, cameras, likeness, constants)
    things = [thing for of_crop in of_crops for thing in of_crop]
    first = np.cumsum([0, *(len(of_crop) for of_crop in of_crops)])
    members = np.concatenate([thing.members for thing in things])
    counts = np.array([len(thing.members) for thing in things])
    starts = np.cumsum(counts) - counts
    owner = np.arange(len(things)).repeat(counts)
    boxes = sights(cameras.take(members), rows.take(members, axis=0))
    poses, likeness = poses.take(members, axis=0), likeness.take(members)
    raw = np.concatenate([each.raw for each in seen]).take(members)
    xy = np.array([(thing.x, thing.y) for thing in things])
    sight = poses[:, 2] + boxes.bearing
    by_heading = constants.evidence.side_by == "heading"
    sides = poses[:, 2] if by_heading else sight
    ratios = _ratios(seen, first, raw, likeness, sides, starts, constants, model)
    size, edges = cues(boxes, poses, sight, xy.take(owner, axis=0), starts, model)
    classes = [matches[thing.members[0]].class_name for thing in things]
    spots, of_spots = _spots(poses, owner)
    marks = Landmarks(
        xy,
        np.array([thing.spread for thing in things]),
        ratios,
        with_class_sizes(size, classes, constants.evidence, model),
        edges,
        spots,
        of_spots,
        np.maximum.reduceat(raw, starts),
    )
    return marks, first


def _things(
    seen: Sequence[Seen],
    begins: Indices,
    poses: Floats,
    boxes: Floats,
    cameras: Cameras,
    likeness: Floats,
    constants: MapConstants,
) -> list[list[_Thing]]:
    """The landmarks of each crop, those with the most similar observation first. The arrays are of
    all crops' matches; ``begins`` has the index of each crop's first."""
    found: list[list[_Thing]] = []
    others: list[list[int]] = []
    for begin, each in zip(begins.tolist(), seen, strict=True):
        by_object: dict[str, tuple[ObjectEstimate, list[int]]] = {}
        rest: list[int] = []
        for index, match in enumerate(each.matches, begin):
            if match.object_estimate is None or match.object_id is None:
                rest.append(index)
            else:
                by_object.setdefault(match.object_id, (match.object_estimate, []))[1].append(index)
        found.append(
            [
                _Thing(np.array(members, dtype=np.intp), at.x, at.y, (at.xx, at.xy, at.yy))
                for at, members in by_object.values()
            ]
        )
        others.append(rest)
    if any(others):
        _add_triangulated(found, seen, others, poses, boxes, cameras, likeness, constants)
    for of_crop, each in zip(found, seen, strict=True):
        best = [float(likeness[thing.members].max()) for thing in of_crop]
        order = sorted(range(len(best)), key=lambda i: (-best[i], int(of_crop[i].members[0])))
        of_crop[:] = [of_crop[i] for i in order[: _most(each)]]
    return found


def _most(seen: Seen) -> int:
    return MAX_LANDMARKS if seen.crop.vector is not None else _MAX_OF_CLASS


def _add_triangulated(
    found: Sequence[list[_Thing]],
    seen: Sequence[Seen],
    others: Sequence[list[int]],
    poses: Floats,
    boxes: Floats,
    cameras: Cameras,
    likeness: Floats,
    constants: MapConstants,
) -> None:
    """Add the landmarks of each crop's ``others``, observations of no Object with a position."""
    crops, indices, weights = [], [], []
    for crop, rest in enumerate(others):
        if not rest:
            continue
        index = np.array(rest, dtype=np.intp)
        alike = likeness[index]
        least = min(constants.evidence.same_class, float(alike.max()) - _RELEVANT_BELOW_BEST)
        index, alike = index[alike >= least], alike[alike >= least]
        crops.append(crop)
        indices.append(index)
        weights.append(np.minimum(np.maximum((alike - least) / _FULL_WEIGHT, 0.1), 1.0))
    index = np.concatenate(indices)
    sizes = np.array([len(each) for each in indices])
    turned, cameras = poses.take(index, axis=0), cameras.take(index)
    turned[:, 2] += cameras.yaw_rad
    looked = views(cameras, boxes.take(index, axis=0))
    rows: list[list[Triangulated]] = triangulate(
        turned,
        looked,
        np.concatenate(weights),
        np.cumsum(sizes) - sizes,
        [_most(seen[crop]) for crop in crops],
        constants.evidence,
    )
    for crop, row in zip(crops, rows, strict=True):
        found[crop].extend(_Thing(index[t.members], t.x, t.y, t.spread) for t in row)


def _ratios(
    seen: Sequence[Seen],
    first: Indices,
    raw: Floats,
    likeness: Floats,
    sides: Floats,
    starts: Indices,
    constants: MapConstants,
    model: RankingModel,
) -> Floats:
    if all(each.crop.vector is None for each in seen):
        return np.full((len(starts), DIRECTIONS), math.exp(model.class_ratio))
    very = np.where(raw > model.same_picture, raw, likeness)
    tables = appearance_tables(very, sides, starts, constants, model)
    for each, begin, end in zip(seen, first[:-1].tolist(), first[1:].tolist(), strict=True):
        if each.crop.vector is None:
            tables[begin:end] = model.class_ratio
        elif each.crop.is_text:
            tables[begin:end] = model.text_weight * tables[begin:end].mean(1, keepdims=True)
    ratios: Floats = np.exp(tables)
    return ratios


def _spots(poses: Floats, owner: Indices) -> tuple[Floats, Indices]:
    """The positions from which each landmark was seen, rounded to 0.18 m, and the index of each
    landmark's first."""
    x, y = np.rint(poses[:, :2].T / _SPOT_M)
    order = np.lexsort((y, x, owner))
    x, y, owner = x[order], y[order], owner[order]
    is_new = np.ones(len(owner), dtype=np.bool_)
    is_new[1:] = (np.diff(owner) != 0) | (np.diff(x) != 0) | (np.diff(y) != 0)
    starts = np.searchsorted(owner[is_new], np.arange(int(owner[-1]) + 1))
    spots: Floats = np.column_stack((x, y))[is_new] * _SPOT_M
    return spots, starts.astype(np.intp)
