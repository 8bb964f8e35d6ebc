"""Trials: each question asked of the map, and its answer compared with the truth.

Beside it are two baselines. *Plain*: the ten observations most similar to each crop; the answer is
the median of their robots' positions, in x and y each. *Best cosine*: the greatest cosine of a crop
and an observation, as a score of whether the thing is in the map.
"""

import math
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from eventsrc.envelope.ingest import Accepted
from eventsrc.log.seek import Note
from projections.fold.map_errors import QuestionError
from projections.fold.settings import CameraConstants
from projections.localize import relocalize
from projections.localize.relocalize import Answer, ExactIndex, MapCandidates, Match, Method, rank
from projections.localize.relocalize.certainty import QuestionSession
from projections.map.view import MapView

from .parallel import call_all
from .questions import FLOOR_HEIGHT_M, ScoredQuestion, floor_of
from .scores import instances_of
from .truth import Key, Truth

NEAREST = 10


def plain_position(matches: Sequence[Sequence[Match]]) -> tuple[float, float] | None:
    """The plain position in metres; None if none of the nearest observations has a pose."""
    poses = [m.pose[:2] for row in matches for m in row[:NEAREST] if m.pose is not None]
    if not poses:
        return None
    x, y = np.median(np.array(poses), axis=0)
    return float(x), float(y)


def best_cosine(matches: Sequence[Sequence[Match]]) -> float:
    """The greatest cosine of all crops; -1 if the map has no observation."""
    return max((row[0].similarity for row in matches if row), default=-1.0)


RIGHT_WITHIN_M = 1.5


class RoomIndex:
    """The room at a position: that of the nearest keyframe whose room is known.

    A pose may lie in a room that none of the map's keyframes entered. So all keyframes of the map's
    log count, those after ``--at`` too, and those of query runs that share an instance with it;
    runs of another building, in another frame, do not.
    """

    def __init__(
        self,
        mapped: Sequence[Accepted],
        asking: Sequence[Accepted],
        truth: Truth,
        floor_height_m: float = FLOOR_HEIGHT_M,
    ) -> None:
        in_map = _instances(mapped, truth)
        runs = {_key(k)[0] for k in asking if in_map & _instances([k], truth)}
        here = [*mapped, *(k for k in asking if _key(k)[0] in runs)]
        known = {key: k for k in here if truth.room(key := _key(k)) is not None}
        self._keys = list(known)
        self._rooms = [truth.room(key) for key in self._keys]
        poses = [(k.envelope.map_x or 0.0, k.envelope.map_y or 0.0) for k in known.values()]
        self._at = _Positions(poses, [floor_of(k, floor_height_m) for k in known.values()])

    def room(self, x: float, y: float, asking: Key, floor: str | None = None) -> str | None:
        """The room at a position in metres, on a floor unless that has no name, without the
        keyframe ``asking``; None if unknown."""
        nearest = self._at.nearest(x, y, floor)[:2]
        return next((self._rooms[i] for i in nearest if self._keys[i] != asking), None)


class _Positions:
    """Positions in metres on floors."""

    def __init__(self, xy: Sequence[tuple[float, float]], floors: Sequence[str | None]) -> None:
        self._xy = np.array(xy, dtype=np.float64).reshape(-1, 2)
        self._floors = np.array(floors, dtype=np.object_)
        self._has_floors = any(floor is not None for floor in floors)

    def nearest(self, x: float, y: float, floor: str | None) -> list[int]:
        """The positions on a floor by distance, ties by number; all of them for None, or if none is
        on a floor with a name."""
        squared = ((self._xy - (x, y)) ** 2).sum(1)
        order = np.argsort(squared, kind="stable")
        if floor is not None and self._has_floors:
            order = order[self._floors[order] == floor]
        return [int(each) for each in order]


def _key(keyframe: Accepted) -> Key:
    return keyframe.envelope.run_id, keyframe.envelope.keyframe_id


def _instances(keyframes: Sequence[Accepted], truth: Truth) -> set[str]:
    found = (truth.keyframes.get(_key(k)) for k in keyframes)
    return {i for line in found if line is not None for i in line.instances if i is not None}


@dataclass(frozen=True, slots=True)
class Trial:
    """One question's outcome. Lengths in metres; None where truth or answer lacks the value.

    Errors of an answer on another floor than the question's are infinite; ``wrong_floor`` is None
    unless both name a floor.

    ``known`` is whether at least one of the crops' true instances is in the map. A place *is* a
    room when most of its keyframes are in it, and *contains* it when any is. ``room_has_place`` is
    whether some place contains the true room: without one no place can be the right answer.
    ``room_of_pose`` is the room of the mapped keyframe nearest to the pose, ``room_at_pose`` the
    room there by the `RoomIndex`, None without one. ``plain_error_m`` and ``best_cosine`` are those
    of the baselines; ``plain_place_error_m`` is the plain method's, a place's centroid.
    """

    question: ScoredQuestion
    answer: Answer
    known: bool
    pose_error_m: float | None
    yaw_error_rad: float | None
    centroid_error_m: float | None
    room_of_pose: str | None
    room_at_pose: str | None
    room_has_place: bool
    rooms_of_places: tuple[str | None, ...]
    contains: tuple[bool, ...]
    nearest_place: bool | None
    plain_error_m: float | None
    plain_place_error_m: float | None
    best_cosine: float
    seconds: float
    wrong_floor: bool | None = None

    @property
    def correct(self) -> bool:
        """Whether the question is known and its pose within 1.5 m of the truth, on its floor."""
        return self.known and self.pose_error_m is not None and self.pose_error_m <= RIGHT_WITHIN_M


@dataclass(frozen=True, slots=True)
class Asked:
    """The answer of a map, without the truth: see `Trial`. Positions are in metres, those of the
    plain method on ``plain_floor``."""

    answer: Answer
    plain_at: tuple[float, float] | None
    plain_place_at: tuple[float, float] | None
    plain_floor: str | None
    best_cosine: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Asker:
    """Asks a map by exact search."""

    index: ExactIndex
    camera: CameraConstants | None
    method: Method

    def ask(self, question: relocalize.Question) -> Asked:
        """The answer, without the poses that it was chosen from; three places asked for."""
        began = time.perf_counter()
        try:
            candidates = self.index.search(question.crops)
        except QuestionError:  # of none but classes that the map does not have: no answer
            nothing = ((),) * len(question.crops)
            candidates = MapCandidates(nothing, self.index.places, self.index.constants)
        answer = rank(question, candidates, top=3, method=self.method, camera=self.camera)
        seconds = time.perf_counter() - began
        plain = rank(question, candidates, top=1, method="plain").pose
        return Asked(
            replace(answer, hypotheses=None),
            plain_position(candidates.matches),
            None if plain is None else (plain.x, plain.y),
            None if plain is None else plain.floor,
            best_cosine(candidates.matches),
            seconds,
        )


class TrialRunner:
    """Asks questions of a folded map, and scores them with the map's own truth."""

    def __init__(
        self,
        view: MapView,
        truth: Truth,
        *,
        camera: CameraConstants | None,
        method: Method,
        room_index: RoomIndex | None = None,
    ) -> None:
        self._room_index = room_index
        self._asker = Asker(ExactIndex(view), camera, method)
        self._instances = {i for _, i in instances_of(view, truth) if i is not None}
        self._rooms: dict[str, Counter[str]] = {p.place_id: Counter() for p in view.places.values()}
        self._keyframes: list[tuple[str | None, str | None]] = []
        positions, floors = [], []
        for keyframe in view.keyframes:
            if keyframe.pose is None:
                continue
            room = truth.room((keyframe.run_id, keyframe.keyframe_id))
            place_id = view.place_id(keyframe.place)
            if room is not None and place_id is not None:
                self._rooms[place_id][room] += 1
            self._keyframes.append((room, place_id))
            positions.append((keyframe.pose.x_um / 1e6, keyframe.pose.y_um / 1e6))
            floors.append(keyframe.floor)
        self._at = _Positions(positions, floors)
        self._rooms_in_map = {room for rooms in self._rooms.values() for room in rooms}

    def run(
        self, questions: Iterable[ScoredQuestion], workers: int = 0, note: Note | None = None
    ) -> list[Trial]:
        """One trial for each question. ``workers`` and ``note``: see `call_all`."""
        asked = list(questions)
        for question in asked:
            self._asker.index.check_spaces(question.crops)
        calls = [partial(self._asker.ask, question.asked) for question in asked]
        answers = call_all(calls, workers, "asking", "questions", note)
        return [self._scored(*each) for each in zip(asked, answers, strict=True)]

    def _scored(self, question: ScoredQuestion, asked: Asked) -> Trial:
        answer = asked.answer
        pose, places = answer.pose, answer.places
        known = any(i in self._instances for i in question.instances if i is not None)
        true_place = self._nearest(question.x, question.y, question.floor)[1]
        floor = None if pose is None else pose.floor
        place_floor = places[0].floor if places else None
        return Trial(
            question,
            answer,
            known,
            _distance(None if pose is None else (pose.x, pose.y), question, floor),
            None if pose is None or pose.yaw is None else _angle_size(pose.yaw - question.yaw),
            _distance(
                (places[0].centroid_x, places[0].centroid_y) if places else None,
                question,
                place_floor,
            ),
            None if pose is None else self._nearest(pose.x, pose.y, floor)[0],
            None
            if pose is None or self._room_index is None
            else self._room_index.room(pose.x, pose.y, question.key, floor),
            question.room in self._rooms_in_map,
            tuple(self._room_of(place.place_id) for place in places),
            tuple((question.room or "") in self._rooms[place.place_id] for place in places),
            None if true_place is None or not places else places[0].place_id == true_place,
            _distance(asked.plain_at, question, asked.plain_floor),
            _distance(asked.plain_place_at, question, asked.plain_floor),
            asked.best_cosine,
            asked.seconds,
            is_elsewhere(floor, question.floor),
        )

    def _nearest(self, x: float, y: float, floor: str | None) -> tuple[str | None, str | None]:
        """Room and place of the map keyframe nearest to a position on a floor; ties go to the
        earlier one."""
        nearest = self._at.nearest(x, y, floor)
        return self._keyframes[nearest[0]] if nearest else (None, None)

    def _room_of(self, place_id: str) -> str | None:
        rooms = self._rooms[place_id]
        return max(sorted(rooms), key=rooms.__getitem__) if rooms else None


SESSION, BEFORE = 20, 10
"""Questions of a session, and how many of them come before the first that is scored."""


def known_of_sessions(trials: Iterable[Trial]) -> list[tuple[float, bool]]:
    """`known` by the questions before it in its session, and the truth; each run's questions, in
    order, are sessions of 20, of which the last ten are scored."""
    by_run: dict[str, list[Trial]] = {}
    for trial in trials:
        by_run.setdefault(trial.question.key[0], []).append(trial)
    found = []
    for asked in by_run.values():
        for number, trial in enumerate(asked):
            if number % SESSION == 0:
                session = QuestionSession()
            looks = trial.answer.looks
            if number % SESSION >= BEFORE:
                known = trial.answer.known if looks is None else session.known(looks)[0]
                found.append((known, trial.known))
            if looks is not None:
                session.add(looks)
    return found


def is_elsewhere(floor: str | None, true_floor: str | None) -> bool | None:
    """Whether two floors differ; None unless both have a name."""
    return None if floor is None or true_floor is None else floor != true_floor


def _distance(
    position: tuple[float, float] | None, question: ScoredQuestion, floor: str | None
) -> float | None:
    """The distance in metres from the question's true position; infinite on another floor."""
    if position is None:
        return None
    if is_elsewhere(floor, question.floor):
        return math.inf
    return math.hypot(position[0] - question.x, position[1] - question.y)


def _angle_size(angle: float) -> float:
    """The size of an angle, 0 … π."""
    return abs(math.remainder(angle, 2.0 * math.pi))
