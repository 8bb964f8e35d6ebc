"""The map of some runs of a log in their own frame, and its things: where they are, how they look
from where, and which points the robot looked at."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from eventsrc.base.progress import report_progress
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import FIRST_OFFSET, KeyframeId, Offset, RunId
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.exact import UNIT
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.fold.sights import camera_of
from projections.localize.relocalize.camera import Cameras, box_rows, camera_values, sights
from projections.localize.relocalize.candidates import ExactIndex
from projections.map.fold import fold_log, fold_parsed, new_map, read_ahead
from projections.map.frames import frames_of
from projections.map.parsing import parsed_stretches
from projections.map.records import EstimatedPosition, KeyframeRecord, ObjectRecord
from projections.map.view import MapView

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

EXEMPLARS: Final = 6
"""The most observations of a thing whose looks are compared, spread over the directions of view."""
_NEAR_M: Final = 3.0
_LEAST_DENSITY: Final = 0.02
_RAY_STEP_M: Final = 0.4
_RAY_BEGIN: Final = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class FramedThings:
    """The n Objects of a map that have an estimated position, metres in the map's frame.

    ``space`` is the embedding space. ``xy`` (n, 2) are positions, ``covariance`` (n, 2, 2) m². The
    m ``looks`` (m, d), unit vectors, and ``sides`` (m,), the directions in which the robot looked,
    radians, are those of ``owners`` (m,), ascending; ``seen`` (n,) is how often each Object was
    seen. ``density`` is the usual number of Objects a square metre, ``different`` the mean cosine
    of different things. ``poses`` (k, 3) are those of the keyframes, ``looked_at`` (p, 2) points
    on the lines of sight to Objects.
    """

    space: str | None
    object_ids: tuple[str, ...]
    classes: NDArray[np.str_]
    xy: Floats
    covariance: Floats
    looks: Floats
    sides: Floats
    owners: Indices
    seen: Indices
    density: float
    different: float
    poses: Floats
    looked_at: Floats

    @property
    def middle(self) -> Floats:
        """The mean position, (2,)."""
        mean: Floats = self.xy.mean(0)
        return mean


def map_of_runs(
    reader: LogReader,
    end: Offset,
    corrections: Corrections,
    settings: Settings,
    without: Collection[RunId],
    without_ranges: Mapping[RunId, tuple[tuple[KeyframeId, KeyframeId], ...]] = MappingProxyType(
        {}
    ),
) -> MapView:
    """The map of the first ``end`` events by evidence, without some runs and some ranges of
    keyframes: where runs have different frames, one map of all of them has everything twice."""
    ranges = dict(corrections.forgotten_ranges)
    for run, more in without_ranges.items():
        ranges[run] = (*ranges.get(run, ()), *more)
    return fold_log(
        reader,
        settings.with_assignments(["fusion=evidence"]),
        end,
        corrections=msgspec.structs.replace(
            corrections,
            forgotten_runs=corrections.forgotten_runs.union(without),
            forgotten_ranges=ranges,
        ),
    )[1]


def own_map(
    reader: LogReader, end: Offset, corrections: Corrections, settings: Settings
) -> MapView:
    """The map by evidence of the keyframes that are in its own frame: one held apart would be a
    second place that looks alike. A run may have keyframes in both."""
    view = map_of_runs(reader, end, corrections, settings, ())
    apart = {each.frame for each in frames_of(view) if each.joined is None}
    ranges = dict[RunId, list[tuple[KeyframeId, KeyframeId]]]()
    for each in view.keyframes:
        joins = corrections.frame_joins(each.frame)
        if (joins[-1].into if joins else each.frame) in apart:
            ranges.setdefault(each.run_id, []).append((each.keyframe_id, each.keyframe_id))
    without = {run: tuple(each) for run, each in ranges.items()}
    return map_of_runs(reader, end, corrections, settings, (), without) if without else view


def maps_of_runs(
    reader: LogReader,
    end: Offset,
    corrections: Corrections,
    settings: Settings,
    runs: Collection[RunId],
) -> dict[RunId, MapView]:
    """The map of each run alone, as by `map_of_runs` without the others, by one pass over the log:
    an envelope is folded into the map of its run only."""
    by_evidence = settings.with_assignments(["fusion=evidence"])
    maps, views = dict[RunId, SemanticMap](), dict[RunId, MapView]()
    for run in runs:
        others = corrections.forgotten_runs.union(set(runs) - {run})
        own = msgspec.structs.replace(corrections, forgotten_runs=others)
        maps[run] = new_map(reader, by_evidence, own)
        views[run] = MapView(by_evidence, corrections=own)
    parsed = parsed_stretches(reader.read(FIRST_OFFSET, end))
    for stretch in read_ahead(parsed, *maps.values()):
        for event in stretch:
            one = event.parsed.envelope.run_id if isinstance(event.parsed, Accepted) else None
            for run in maps if one is None else maps.keys() & {one}:
                views[run].apply_event(event.offset, fold_parsed(event, maps[run]))
        report_progress("mapping each run", stretch[-1].offset + 1, max(end, 1))
    report_progress("mapping each run", max(end, 1), max(end, 1))
    return views


def things_of_map(view: MapView) -> FramedThings | None:
    """The things of a map that was folded by evidence, with embeddings; None if it has none."""
    found: list[tuple[ObjectRecord, EstimatedPosition, list[tuple[float, int]]]] = []
    for each in view.objects.values():
        exemplars = _exemplars(view, each)
        if each.estimate is not None and exemplars:
            found.append((each, each.estimate, exemplars))
    if not found:
        return None
    rows = [number for *_, exemplars in found for _, number in exemplars]
    xy = np.array([(at.est_x, at.est_y) for _, at, _ in found])
    squares = np.array([at.covariance_m2 for _, at, _ in found])
    near = np.mean([(np.hypot(*(xy - each).T) <= _NEAR_M).sum() for each in xy])
    index = ExactIndex(view)
    return FramedThings(
        index.model,
        tuple(each.object_id for each, *_ in found),
        np.array([each.class_name for each, *_ in found]),
        xy,
        squares[:, [0, 1, 1, 2]].reshape(-1, 2, 2),
        view.vectors(np.array(rows, dtype=np.int64)).astype(np.float64) / UNIT,
        np.array([side for *_, exemplars in found for side, _ in exemplars]),
        np.repeat(np.arange(len(found)), [len(exemplars) for *_, exemplars in found]),
        np.array([len(each.observations) for each, *_ in found]),
        max(float(near) / (math.pi * _NEAR_M**2), _LEAST_DENSITY),
        index.constants.different,
        np.array([pose for each in view.keyframes if (pose := _pose(each)) is not None]),
        _looked_at(view, [each for each, *_ in found], xy),
    )


def _exemplars(view: MapView, thing: ObjectRecord) -> list[tuple[float, int]]:
    """Observations with a look and a pose, spread evenly over the directions in which the robot
    looked: radians in the map's frame within ±π, and ordinals."""
    every, poses, cameras = [], [], []
    for number in thing.observations:
        seen = view.observations[number]
        keyframe = view.keyframes[seen.keyframe]
        pose = _pose(keyframe)
        if seen.embedding is not None and pose is not None:
            every.append(seen)
            poses.append(pose[2])
            cameras.append(camera_values(camera_of(keyframe.camera, view.settings.camera)))
    if not every:
        return []
    boxes = sights(Cameras.of(cameras), box_rows([seen.bbox for seen in every]))
    sides = (np.array(poses) + boxes.bearing).tolist()
    rows = sorted(
        (math.remainder(side, math.tau), int(seen.ordinal))
        for side, seen in zip(sides, every, strict=True)
    )
    steps = np.linspace(0, len(rows) - 1, min(EXEMPLARS, len(rows))).round().astype(int)
    return [rows[step] for step in steps.tolist()]


def _pose(keyframe: KeyframeRecord) -> tuple[float, float, float] | None:
    pose = keyframe.pose
    return None if pose is None else (pose.x_m, pose.y_m, pose.yaw_rad)


def _looked_at(view: MapView, things: list[ObjectRecord], xy: Floats) -> Floats:
    """Points on the lines of sight from keyframes to the things that they show, (p, 2)."""
    points = []
    for thing, there in zip(things, xy, strict=True):
        for number in thing.observations:
            pose = _pose(view.keyframes[view.observations[number].keyframe])
            if pose is not None:
                here = np.array(pose[:2])
                count = max(2, int(math.dist(here, there) / _RAY_STEP_M))
                shares = np.linspace(_RAY_BEGIN, 1.0, count)[:, None]
                points.append(here + (there - here) * shares)
    return np.concatenate(points)
