"""Questions from a map's own keyframes, asked as if the visit with the keyframe were not in the
map; and their scores, which need no truth.

Each question has crops of a keyframe of the map. The *visit*, the observations of its run within
`VISIT` keyframes of it, is taken out of the map. Likenesses within a run are higher than between
days, so the cosines to the rest of the run are lowered by the map's session shift. A thing that was
seen at another time, too, is then *known*.

With the Objects of the things shown taken out, too, the same question is about unknown things.
Objects of the same class beside them are taken out as well: the fold may have split them off.
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from eventsrc.base.text import counted
from eventsrc.envelope.model import RunId
from eventsrc.log.seek import Note
from projections.fold.deltas import ObservationOrdinal
from projections.fold.exact import to_float32
from projections.fold.sights import camera_of
from projections.localize.relocalize import Answer, ExactIndex, Match, QuestionCrop, rank
from projections.localize.relocalize.constants import USUAL_DAY
from projections.map.records import KeyframeRecord, ObjectRecord, ObservationRecord
from projections.map.view import MapView

from .parallel import call_all
from .questions import DEFAULT_SEED, draw_key, spread
from .scores import (
    auroc,
    calibration_floor,
    expected_calibration_error,
    percentiles,
    reliability,
    share,
)
from .trials import RIGHT_WITHIN_M, best_cosine, is_elsewhere, plain_position

VISIT = 20
"""Keyframes of a run are of one visit if their keyframe_ids differ by no more than this."""
STAND_APART_M, SEEN_APART_M = 2.0, 3.0
"""Objects of one class are taken out together if they are nearer to each other, or within twice
that if one was seen from a single spot; under ``fusion = "page"`` the positions that they were seen
from are compared."""
MOST = 100
"""The most keyframes asked from, spread evenly over the map."""


@dataclass(frozen=True, slots=True)
class OwnAnswer:
    """The answer to one of the map's own questions with this number of ``crops``.

    ``known`` is whether something shown was observed outside the visit too, ``taken_out`` whether
    the things shown were taken out of the map. Errors are in metres, None without a pose, infinite
    on another floor.
    """

    crops: int
    taken_out: bool
    known: bool
    answer: Answer
    error_m: float | None
    plain_error_m: float | None
    best_cosine: float

    @property
    def correct(self) -> bool:
        """Whether the things are known and the pose is within 1.5 m."""
        return self.known and self.error_m is not None and self.error_m <= RIGHT_WITHIN_M


class OwnQuestions:
    """The questions with ``crops`` crops from up to ``most`` of the keyframes that have as many."""

    def __init__(
        self, view: MapView, crops: int, *, most: int = MOST, seed: int = DEFAULT_SEED
    ) -> None:
        self._view, self._crops = view, crops
        self._index = ExactIndex(view)
        self._runs, self._by_class = _by_run(view), _by_class(view)
        askable = [
            (keyframe, seen)
            for keyframe in view.keyframes
            if keyframe.pose is not None
            and len(seen := _drawn(view, keyframe, crops, seed)) == crops
        ]
        self._chosen = spread(askable, most)

    def __len__(self) -> int:
        """Keyframes that are asked from."""
        return len(self._chosen)

    def ask(self, number: int) -> tuple[OwnAnswer, OwnAnswer]:
        """Ask from one of the keyframes: first with the visit taken out, then with the things shown
        taken out too."""
        keyframe, seen = self._chosen[number]
        constants = self._index.constants
        lowered = constants.evidence.session_shift * (1.0 - constants.different)
        asked = [_crop(self._view.observations[ordinal]) for ordinal in seen]
        camera = camera_of(keyframe.camera, self._view.settings.camera)
        visit = _visit(self._runs, keyframe)
        shown = _observations_of_things(self._view, self._by_class, seen)

        def answered(taken_out: bool) -> OwnAnswer:
            found = self._index.search(asked, without=visit | shown if taken_out else visit)
            rows = tuple(_another_day(row, keyframe.run_id, lowered) for row in found.matches)
            used = replace(found.constants, session=USUAL_DAY)
            found = replace(found, matches=rows, constants=used)
            answer = rank(asked, found, top=1, camera=camera)
            pose = None if answer.pose is None else (answer.pose.x, answer.pose.y)
            floor = None if answer.pose is None else answer.pose.floor
            return OwnAnswer(
                self._crops,
                taken_out,
                not taken_out and bool(shown - visit),
                replace(answer, hypotheses=None),
                math.inf if is_elsewhere(floor, keyframe.floor) else _error(keyframe, pose),
                _error(keyframe, plain_position(rows)),
                best_cosine(rows),
            )

        return answered(False), answered(True)


def ask_own_questions(
    view: MapView,
    crops: int,
    *,
    most: int = MOST,
    seed: int = DEFAULT_SEED,
    workers: int = 0,
    note: Note | None = None,
) -> list[OwnAnswer]:
    """All answers to `OwnQuestions`. ``workers`` and ``note``: see `call_all`."""
    questions = OwnQuestions(view, crops, most=most, seed=seed)
    calls = [partial(questions.ask, number) for number in range(len(questions))]
    stage = f"asking about itself, {counted(crops, 'crop')}"
    answers = call_all(calls, workers, stage, "keyframes", note)
    return [answer for pair in answers for answer in pair]


def _by_run(view: MapView) -> dict[RunId, list[KeyframeRecord]]:
    runs: dict[RunId, list[KeyframeRecord]] = {}
    for keyframe in view.keyframes:
        runs.setdefault(keyframe.run_id, []).append(keyframe)
    for keyframes in runs.values():
        keyframes.sort(key=lambda keyframe: keyframe.keyframe_id)
    return runs


def _by_class(view: MapView) -> dict[str, list[ObjectRecord]]:
    classes: dict[str, list[ObjectRecord]] = {}
    for thing in view.objects.values():
        classes.setdefault(thing.class_name, []).append(thing)
    return classes


def _visit(
    runs: dict[RunId, list[KeyframeRecord]], keyframe: KeyframeRecord
) -> set[ObservationOrdinal]:
    """The observations of the keyframes of its run within `VISIT` of one, by keyframe_id."""
    own, number = runs[keyframe.run_id], keyframe.keyframe_id
    first = bisect_left(own, number - VISIT, key=lambda each: each.keyframe_id)
    last = bisect_right(own, number + VISIT, key=lambda each: each.keyframe_id)
    return {ordinal for each in own[first:last] for ordinal in each.observations}


def _drawn(
    view: MapView, keyframe: KeyframeRecord, crops: int, seed: int
) -> list[ObservationOrdinal]:
    """Up to ``crops`` of a keyframe's observations that have an embedding."""
    usable = [o for o in keyframe.observations if view.observations[o].embedding is not None]
    return sorted(usable, key=lambda o: draw_key(seed, view.observations[o].det_id))[:crops]


def _observations_of_things(
    view: MapView, by_class: dict[str, list[ObjectRecord]], seen: Sequence[ObservationOrdinal]
) -> set[ObservationOrdinal]:
    """These observations, the others of their Objects, and those of Objects that may be the same
    thing."""
    found = set(seen)
    for ordinal in seen:
        number = view.observations[ordinal].object
        if number is not None:
            thing = view.objects[number]
            for other in by_class[thing.class_name]:
                if other is thing or _may_be_one(thing, other):
                    found.update(other.observations)
    return found


def _may_be_one(one: ObjectRecord, other: ObjectRecord) -> bool:
    """Whether two Objects of one class are so near each other that they may be one thing."""
    if one.estimate is not None and other.estimate is not None:
        dx = one.estimate.est_x - other.estimate.est_x
        dy = one.estimate.est_y - other.estimate.est_y
        unsure = min(one.estimate.spots, other.estimate.spots) < 2
        return math.hypot(dx, dy) < STAND_APART_M * (1 + unsure)
    return math.hypot(one.mean_x - other.mean_x, one.mean_y - other.mean_y) < SEEN_APART_M


def _crop(observation: ObservationRecord) -> QuestionCrop:
    assert observation.embedding is not None  # noqa: S101 - drawn among those that have one
    look = to_float32(observation.embedding)
    return QuestionCrop(look, observation.bbox, observation.class_name, observation.det_id)


def _another_day(row: Sequence[Match], run_id: RunId, lowered: float) -> tuple[Match, ...]:
    """The matches as if those of one run were of another day, most similar first."""
    moved = [
        match._replace(similarity=match.similarity - lowered) if match.run_id == run_id else match
        for match in row
    ]
    return tuple(sorted(moved, key=lambda match: (-match.similarity, match.observation)))


def _error(keyframe: KeyframeRecord, at: tuple[float, float] | None) -> float | None:
    if at is None or keyframe.pose is None:
        return None
    return math.hypot(at[0] - keyframe.pose.x_m, at[1] - keyframe.pose.y_m)


Number = Callable[[OwnAnswer], float]


def own_scores(
    answers: Sequence[OwnAnswer],
    known_of: Number = lambda each: each.answer.known,
    confidence_of: Number = lambda each: each.answer.confidence,
    unknown_below: float = 0.5,
) -> dict[str, Any]:
    """Scores in the shape of ``evaluate --self --json``, for one number of crops.

    Errors are of known questions, those with the visit taken out of which something was seen at
    another time. ``taken_out_called_known`` is the share of those with the things shown taken out.
    """
    known = [each for each in answers if each.known]
    gone = [each for each in answers if each.taken_out]
    unknown = [each for each in answers if not each.known]
    in_map, sure = [known_of(each) for each in answers], [confidence_of(each) for each in answers]
    is_known, is_right = [each.known for each in answers], [each.correct for each in answers]
    return {
        "questions": len(answers),
        "known": len(known),
        "pose_error_m": percentiles(each.error_m for each in known),
        "within_1_5_m": share(each.correct for each in known),
        "known_called_unknown": share(known_of(each) < unknown_below for each in known),
        "taken_out_called_known": share(known_of(each) >= unknown_below for each in gone),
        "auroc": auroc([known_of(e) for e in known], [known_of(e) for e in unknown]),
        "known_ece": expected_calibration_error(in_map, is_known),
        "known_ece_floor": calibration_floor(in_map),
        "ece": expected_calibration_error(sure, is_right),
        "ece_floor": calibration_floor(sure),
        "known_reliability": reliability(in_map, is_known),
        "reliability": reliability(sure, is_right),
        "plain": {"pose_error_m": percentiles(each.plain_error_m for each in known)},
        "best_cosine": {
            "auroc": auroc([e.best_cosine for e in known], [e.best_cosine for e in unknown])
        },
    }
