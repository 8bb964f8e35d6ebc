"""Small scenes for the localiser: things on a plane, mapped views of them, a question, candidates.

No embeddings: a match's cosine is made from whether it shows the same thing and from the change of
side, as `projections.fold.evidence` describes it.

MapCandidates of the databases beside those of exact search, for tests.

MapCandidates whose Places are the true rooms, so that ranking is tested without clustering.

Which thing each detection on a drawn picture shows, from what the picture truly shows.
"""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eventsrc.log import LogReader
from projections.fold.evidence import EvidenceConstants
from projections.fold.exact import quantise, to_float32
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import CameraConstants, Settings
from projections.localize.relocalize import (
    CandidatePlace,
    ExactIndex,
    MapCandidates,
    MapConstants,
    Match,
    ObjectEstimate,
    Question,
    QuestionCrop,
    QuestionView,
)
from projections.localize.relocalize.camera import half_field_rad
from projections.localize.relocalize.question import Box
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from tests.support.buildings import Keyframe

Pose = tuple[float, float, float]
EVIDENCE = EvidenceConstants(range_m=2.5)
CONSTANTS = MapConstants(evidence=EVIDENCE, different=0.5, different_spread=0.06)
UP_M = 0.4
"""The camera's height."""
FARTHEST_M = 5.0
"""Farther things are not detected."""


@dataclass(frozen=True)
class Thing:
    """Where it stands, how tall it is from the ground, and what it is called."""

    x: float
    y: float
    tall_m: float = 1.0
    name: str = "chair"


def box_of(thing: Thing, pose: Pose, camera: CameraConstants) -> Box | None:
    """What an upright line of the thing's height gives; None if it is not in the picture."""
    dx, dy = thing.x - pose[0], thing.y - pose[1]
    ahead = math.cos(pose[2]) * dx + math.sin(pose[2]) * dy
    left = math.cos(pose[2]) * dy - math.sin(pose[2]) * dx
    if not 0.3 < ahead < FARTHEST_M:
        return None
    focal = camera.width_px / 2 / math.tan(half_field_rad(camera))
    middle = camera.width_px / 2 - focal * left / ahead
    if not 0.0 < middle < camera.width_px:
        return None
    half = 0.2 * focal / ahead
    rise = focal / ahead
    return (
        max(0.0, middle - half),
        max(0.0, camera.height_px / 2 - (thing.tall_m - UP_M) * rise),
        min(camera.width_px, middle + half),
        min(camera.height_px, camera.height_px / 2 + UP_M * rise),
    )


def cosine(constants: MapConstants, likeness: float) -> float:
    """The cosine of a relative likeness."""
    return constants.different + likeness * (1.0 - constants.different)


@dataclass(frozen=True)
class Scene:
    """Things, the poses that the map was made from, and the constants of the map."""

    things: Sequence[Thing]
    poses: Sequence[Pose]
    constants: MapConstants = CONSTANTS
    camera: CameraConstants = field(default_factory=CameraConstants)
    has_estimates: bool = True

    def match(self, number: int, index: int, pose: Pose, likeness: float) -> Match | None:
        """Thing ``index`` as mapped from a pose; None if it was not in view."""
        thing = self.things[index]
        box = box_of(thing, pose, self.camera)
        if box is None:
            return None
        estimate = (
            ObjectEstimate(thing.x, thing.y, 0.02, 0.0, 0.02, 3) if self.has_estimates else None
        )
        similarity = cosine(self.constants, likeness)
        return Match(
            number, f"d{number}", "mapped", similarity, pose, box, thing.name, f"o{index}",
            object_estimate=estimate,
        )  # fmt: skip

    def row(
        self, shown: int | None, at: Pose, noise: float = 0.0, seed: int = 0
    ) -> tuple[Match, ...]:
        """The matches of a crop that shows thing ``shown`` from ``at``, most similar first."""
        rng = np.random.default_rng(seed)
        evidence, found = self.constants.evidence, []
        for index in range(len(self.things)):
            for place, pose in enumerate(self.poses):
                thing = self.things[index]
                mapped = math.atan2(thing.y - pose[1], thing.x - pose[0])
                asked = math.atan2(thing.y - at[1], thing.x - at[0])
                side = math.exp(evidence.same_kappa * (math.cos(mapped - asked) - 1.0))
                likeness = evidence.same_back + evidence.same_side * side - evidence.session_shift
                if index != shown:
                    likeness = 0.3 if shown is not None else 0.1
                number = index * len(self.poses) + place
                match = self.match(number, index, pose, likeness + noise * rng.standard_normal())
                if match is not None:
                    found.append(match)
        return tuple(sorted(found, key=lambda m: (-m.similarity, m.observation)))

    def crop(self, shown: int, at: Pose, *, boxed: bool = True) -> QuestionCrop:
        """Thing ``shown`` as seen from ``at``. The vector only tells crops apart."""
        box = box_of(self.things[shown], at, self.camera) if boxed else None
        vector = np.full(4, shown, dtype=np.float32)
        return QuestionCrop(vector, box, self.things[shown].name, f"crop-{shown}")

    def in_view(self, at: Pose) -> list[int]:
        """Things that a picture from a pose shows."""
        return [i for i, thing in enumerate(self.things) if box_of(thing, at, self.camera)]

    def ask(
        self, ats: Sequence[tuple[Pose, Sequence[int]]], noise: float = 0.0, *, boxed: bool = True
    ) -> tuple[Question, MapCandidates]:
        """A question whose views show things from poses, with the movement between them."""
        views, rows = [], []
        for number, (at, shown) in enumerate(ats):
            moved = (0.0, 0.0, 0.0) if number == 0 else movement(ats[number - 1][0], at)
            views.append(QuestionView(*moved, tuple(self.crop(i, at, boxed=boxed) for i in shown)))
            rows += [self.row(i, at, noise, seed=i + 100 * number) for i in shown]
        return Question(tuple(views)), MapCandidates(tuple(rows), {}, self.constants)


def movement(before: Pose, after: Pose) -> Pose:
    """Metres ahead and left in the first pose's frame, and the turn."""
    dx, dy = after[0] - before[0], after[1] - before[1]
    cos, sin = math.cos(before[2]), math.sin(before[2])
    turn = math.remainder(after[2] - before[2], 2.0 * math.pi)
    return cos * dx + sin * dy, cos * dy - sin * dx, turn


def around(thing: Thing, count: int, far_m: float = 2.0, start: float = 0.0) -> list[Pose]:
    """Poses on a circle about a thing that look at it."""
    angles = [start + 2.0 * math.pi * k / count for k in range(count)]
    return [
        (thing.x + far_m * math.cos(a), thing.y + far_m * math.sin(a), a + math.pi) for a in angles
    ]


def found(candidates: MapCandidates) -> list[list[tuple[object, ...]]]:
    """All that matches say but their similarity, in the order of the fold."""
    return [
        [
            (
                m.det_id,
                m.run_id,
                m.pose,
                m.bbox,
                m.class_name,
                m.object_id,
                m.object_place,
                m.keyframe_place,
                m.camera,
                m.object_estimate,
            )
            for m in sorted(row, key=lambda m: m.observation)
        ]
        for row in candidates.matches
    ]


def assert_equal(live: MapCandidates, exact: MapCandidates) -> None:
    """Both have the same matches, places and constants; cosines but for rounding."""
    assert found(live) == found(exact)
    assert live.constants == exact.constants
    for ours, theirs in zip(live.matches, exact.matches, strict=True):
        assert [m.similarity for m in ours] == pytest.approx(
            [m.similarity for m in theirs], abs=1e-5
        )
        for match in theirs:
            for place in {match.object_place, match.keyframe_place} - {None}:
                assert live.places[place] == exact.places[place]  # type: ignore[index]


def view_under_commands(log: Path) -> MapView:
    """The map of a log with the settings of its commands."""
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        return fold_log(reader, corrections.settings or Settings(), corrections=corrections)[1]


def fold(run: Sequence[Keyframe], **settings: float) -> MapView:
    """The map of a run."""
    chosen = Settings.model_validate({"eps_m": 1.0, **settings})
    semantic_map, view = SemanticMap(chosen), MapView(chosen)
    for offset, keyframe in enumerate(run):
        view.apply_event(offset, semantic_map.fold(offset, keyframe.accepted))
    return view


def crops_of(keyframe: Keyframe, *, boxes: bool = True) -> list[QuestionCrop]:
    """A keyframe's detections as crops."""
    return [
        QuestionCrop(
            to_float32(quantise(vector)),
            detection.bbox if boxes else None,
            detection.class_name,
            det_id,
        )
        for vector, detection, det_id in zip(
            keyframe.accepted.vectors,
            keyframe.accepted.envelope.detections,
            keyframe.accepted.det_ids,
            strict=True,
        )
        if vector is not None
    ]


class RoomMap:
    """A mapped run, searched exactly, with the rooms as Places."""

    def __init__(self, run: Sequence[Keyframe]) -> None:
        self.run = run
        self.view = fold(run)
        self._index = ExactIndex(self.view)
        self.rooms = sorted({keyframe.room for keyframe in run})
        self._places = {i: CandidatePlace(room, float(i), 0.0) for i, room in enumerate(self.rooms)}

    def search(self, crops: Sequence[QuestionCrop]) -> MapCandidates:
        """As `ExactIndex.search`, each match in the room its keyframe is in."""
        found = self._index.search(crops)
        rows = tuple(tuple(self._in_room(m) for m in row) for row in found.matches)
        return MapCandidates(rows, self._places)

    def _in_room(self, match: Match) -> Match:
        keyframe = self.view.observations[match.observation].keyframe
        room = self.rooms.index(self.run[keyframe].room)
        return match._replace(object_place=room, keyframe_place=room)


LEAST_OVERLAP = 0.5


def truth_of(envelopes: Iterable[dict[str, Any]], truth: Path) -> list[dict[str, Any]]:
    """Truth in the form of `evaluate`, a document for each envelope.

    A detection shows the thing of its class whose box overlaps its own most, by half at least.
    """
    pictures = {p["stamp"]: p for p in map(json.loads, truth.read_text().splitlines())}
    return [_of_one(envelope, pictures[envelope["timestamp"]]) for envelope in envelopes]


def _of_one(envelope: dict[str, Any], picture: dict[str, Any]) -> dict[str, Any]:
    return {
        "run_id": envelope["run_id"],
        "keyframe_id": envelope["keyframe_id"],
        "room": picture["room"],
        "instances": [_instance(d, picture["things"]) for d in envelope["detections"]],
    }


def _instance(detection: dict[str, Any], things: list[dict[str, Any]]) -> str | None:
    near = [
        (_overlap(detection["bbox"], thing["box"]), thing["instance"])
        for thing in things
        if thing["class"] == detection["class"]
    ]
    best = max(near, default=(0.0, None))
    return best[1] if best[0] >= LEAST_OVERLAP else None


def _overlap(one: list[float], other: list[float]) -> float:
    sides = [min(one[i + 2], other[i + 2]) - max(one[i], other[i]) for i in (0, 1)]
    shared = max(0.0, sides[0]) * max(0.0, sides[1])
    areas = [(b[2] - b[0]) * (b[3] - b[1]) for b in (one, other)]
    return shared / (sum(areas) - shared)
