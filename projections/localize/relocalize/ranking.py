"""The ranking: from crops and their candidates to an answer. No clock, no chance, no I/O.

The joint method weighs poses (`pose`), and a Place's score is the share of their weight that lies
in it: each pose counts for the Place of the nearest keyframe among the candidates. Places that no
pose lies in come last, by the plain method's sums. Ties go to the Place founded first. Crops are
sorted first, so the order in which they were sent does not matter.

The plain method is the baseline that everything else is measured against: each of the ten nearest
observations of a crop gives its similarity to the Place of its Object; the Place with the greatest
sum wins; the pose is its centroid.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, Literal

import numpy as np

from projections.fold.deltas import PlaceOrdinal
from projections.fold.settings import CameraConstants

from .candidates import MapCandidates, Match
from .certainty import UNKNOWN_BELOW, Looks, QuestionSession, known_probability, looks_of, thinness
from .constants import MODEL, RankingModel
from .layout import Hypotheses, Layout
from .likelihood import Scene
from .pose import Posterior, locate
from .question import Question, QuestionCrop, QuestionView

Method = Literal["joint", "plain"]
PLAIN_NEIGHBOURS: Final = 10


@dataclass(frozen=True, slots=True)
class Evidence:
    """An observation in the map that supports a Place. ``object_id`` is None if unfused.

    ``compared`` is False where the crop is a class alone: ``similarity`` is then 1.
    """

    det_id: str
    object_id: str | None
    class_name: str
    similarity: float
    compared: bool = True

    def document(self) -> dict[str, Any]:
        """As JSON."""
        document = asdict(self)
        del document["compared"]
        return document


@dataclass(frozen=True, slots=True)
class RankedPlace:
    """A Place and its score: the share of the poses' weight that lies in it.

    With the plain method the score is the sum of similarities. The centroid is in metres.
    ``name`` is None where the Place has no name, ``floor`` where the log names no floor.
    """

    place_id: str
    score: float
    centroid_x: float
    centroid_y: float
    evidence: tuple[Evidence, ...]
    name: str | None = None
    floor: str | None = None

    def document(self) -> dict[str, Any]:
        """As JSON; only a Place that has a name or a floor has that key."""
        document = asdict(self) | {"evidence": [each.document() for each in self.evidence]}
        for key in ("name", "floor"):
            if document[key] is None:
                del document[key]
        return document


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """Metres and radians in the map frame; ``yaw`` is None when the evidence leaves it open.

    ``spread_m`` is the root mean square distance of all weighed poses from this one, of those on
    its floor. ``floor`` is the floor it is on, None where the log names none.
    """

    x: float
    y: float
    yaw: float | None
    spread_m: float
    floor: str | None = None

    def document(self) -> dict[str, Any]:
        """As JSON; only a pose on a floor with a name has that key."""
        document = asdict(self)
        if self.floor is None:
            del document["floor"]
        return document


@dataclass(frozen=True, slots=True)
class Answer:
    """Two calibrated probabilities: ``known`` that the map has one of the things shown,
    ``confidence`` that the pose is right within 1.5 m.

    ``hypotheses`` are the poses from which the answer was chosen; None where there is no pose, and
    with the plain method. ``thin`` names what the map has too little of (`certainty.thinness`),
    None where it has enough. ``unlooked`` is the number of crops whose embeddings say nothing,
    since the map has none. ``looks`` is what ``known`` was computed from, None without embeddings.
    """

    places: tuple[RankedPlace, ...]
    pose: PoseHypothesis | None
    confidence: float
    known: float = 0.0
    hypotheses: Hypotheses | None = field(default=None, compare=False, repr=False)
    thin: str | None = None
    unlooked: int = 0
    looks: Looks | None = None

    @property
    def known_spread(self) -> float | None:
        """The standard deviation of ``known``, from the uncertain loss of likeness on another day
        (`SessionPrior`); None without embeddings."""
        return None if self.looks is None else QuestionSession().known(self.looks)[1]

    @property
    def unknown(self) -> bool:
        """Whether the things shown are more likely not in the map."""
        return self.known < UNKNOWN_BELOW

    def document(self) -> dict[str, Any]:
        """The answer as JSON, in the shape of ``relocalize --json``."""
        return {
            "places": [place.document() for place in self.places],
            "pose": None if self.pose is None else self.pose.document(),
            "confidence": self.confidence,
            "known": self.known,
            "known_spread": self.known_spread,
            "unknown": self.unknown,
            "thin": self.thin,
        }


def rank(
    question: Question | Sequence[QuestionCrop],
    candidates: MapCandidates,
    *,
    top: int = 3,
    method: Method = "joint",
    camera: CameraConstants | None = None,
    model: RankingModel = MODEL,
) -> Answer:
    """The answer to a question, or to the crops of one picture; ``candidates.matches`` run parallel
    to the crops. The camera is that of the question, else ``camera``, else the one that took most
    of the observations found."""
    asked = question if isinstance(question, Question) else Question.of(question)
    unlooked = 0
    if candidates.by_class:
        given = [crop for view in asked.views for crop in view.crops]
        asked = asked.by_class()
        kept = [crop for view in asked.views for crop in view.crops]
        unlooked = sum(a.vector is not b.vector for a, b in zip(given, kept, strict=True))
    views, candidates = _in_order(asked, candidates)
    crops = [crop for view in views for crop in view.crops]
    looks = looks_of(crops, candidates.matches, candidates.constants)
    known = known_probability(looks, candidates.matches)
    thin = thinness(crops, candidates.matches)
    if method == "plain":
        answer = _rank_plain(candidates, crops, top)
    else:
        floors = Layout.of(candidates)
        candidates = floors.laid_out(candidates)
        camera = asked.camera or camera or _camera_of_most(candidates)
        scene = Scene(candidates.constants, camera, model, floors.walls(candidates.walls))
        posterior = locate(views, candidates.matches, scene)
        answer = _answer(candidates, crops, posterior, top, floors)
    return replace(answer, known=known, thin=thin, unlooked=unlooked, looks=looks)


def _camera_of_most(candidates: MapCandidates) -> CameraConstants:
    """The camera of most matches; of several with as many, that of the earliest match."""
    counts = Counter(match.camera for row in candidates.matches for match in row)
    most = max(counts, key=counts.__getitem__, default=None)
    if most is None:
        return candidates.constants.camera
    hfov_deg, width_px, height_px, yaw_rad = most
    return CameraConstants(
        hfov_deg=hfov_deg, width_px=width_px, height_px=height_px, yaw_rad=yaw_rad
    )


def _in_order(
    question: Question, candidates: MapCandidates
) -> tuple[list[QuestionView], MapCandidates]:
    """The views with sorted crops, and their candidates in that order."""
    views, rows, start = [], [], 0
    for view in question.views:
        crops = view.crops
        order = sorted(range(len(crops)), key=lambda index: crops[index].sort_key)
        views.append(replace(view, crops=tuple(crops[index] for index in order)))
        rows += [candidates.matches[start + index] for index in order]
        start += len(crops)
    return views, replace(candidates, matches=tuple(rows))


def _answer(
    candidates: MapCandidates,
    crops: Sequence[QuestionCrop],
    posterior: Posterior | None,
    top: int,
    floors: Layout,
) -> Answer:
    sums = _similarity_sums(candidates.matches)
    shares = {} if posterior is None else _place_shares(candidates, posterior)
    known = sorted(shares.keys() | sums.keys())
    order = sorted(known, key=lambda p: (-shares.get(p, 0.0), -sums.get(p, 0.0), p))
    scores = {place: shares.get(place, 0.0) for place in known}
    places = _ranked_places(candidates, crops, order[:top], scores)
    if posterior is None:
        return Answer(places, None, 0.0)
    x, floor = floors.put_back(posterior.x), floors.floor_at(posterior.x)
    spread = floors.spread_m(posterior)
    pose = PoseHypothesis(x, posterior.y, posterior.yaw, spread, floor)
    return Answer(places, pose, posterior.confidence, hypotheses=floors.hypotheses(posterior))


def _place_shares(candidates: MapCandidates, posterior: Posterior) -> dict[PlaceOrdinal, float]:
    """The weight of the poses by the Place of the nearest placed candidate keyframe; at most 1,
    which a rounded sum may exceed."""
    placed = sorted(
        {
            (match.pose[0], match.pose[1], place)
            for row in candidates.matches
            for match in row
            if match.pose is not None
            and (place := _either(match.keyframe_place, match.object_place)) is not None
        }
    )
    if not placed:
        return {}
    x, y, places = zip(*placed, strict=True)
    dx = posterior.poses[:, 0, None] - np.array(x)
    dy = posterior.poses[:, 1, None] - np.array(y)
    dx *= dx
    dy *= dy
    dx += dy
    owners = np.array(places).take(dx.argmin(axis=1))
    return {
        PlaceOrdinal(place): min(float(posterior.weights[owners == place].sum()), 1.0)
        for place in sorted(set(owners.tolist()))
    }


def _either(first: PlaceOrdinal | None, second: PlaceOrdinal | None) -> PlaceOrdinal | None:
    return second if first is None else first


def _ranked_places(
    candidates: MapCandidates,
    crops: Sequence[QuestionCrop],
    order: Sequence[PlaceOrdinal],
    scores: Mapping[PlaceOrdinal, float],
) -> tuple[RankedPlace, ...]:
    """The places of ``order`` (ordinals) with their scores and evidence."""
    ranked = []
    for ordinal in order:
        place = candidates.places[ordinal]
        evidence = _evidence(candidates.matches, crops, ordinal)
        ranked.append(
            RankedPlace(
                place.place_id,
                scores[ordinal],
                place.x,
                place.y,
                evidence,
                place.name,
                place.floor,
            )
        )
    return tuple(ranked)


def _evidence(
    matches: Sequence[Sequence[Match]], crops: Sequence[QuestionCrop], place: PlaceOrdinal
) -> tuple[Evidence, ...]:
    """The best match of each crop whose Object is located in the place, or was seen from it."""
    best = [
        next(((m, crop) for m in row if place in (m.object_place, m.keyframe_place)), None)
        for row, crop in zip(matches, crops, strict=True)
    ]
    found = sorted(
        (each for each in best if each is not None),
        key=lambda each: (-each[0].similarity, each[0].observation),
    )
    return tuple(
        Evidence(m.det_id, m.object_id, m.class_name, m.similarity, crop.vector is not None)
        for m, crop in found
    )


def _rank_plain(candidates: MapCandidates, crops: Sequence[QuestionCrop], top: int) -> Answer:
    """The plain method's answer. Its confidence is the winner's share of all similarity."""
    sums = _similarity_sums(candidates.matches)
    if not sums:
        return Answer((), None, 0.0)
    order = sorted(sums, key=lambda place: (-sums[place], place))
    winner = candidates.places[order[0]]
    share = sums[order[0]] / math.fsum(sums.values())
    places = _ranked_places(candidates, crops, order[:top], sums)
    spread = _spread(candidates, order[0], winner.x, winner.y)
    pose = PoseHypothesis(winner.x, winner.y, None, spread, winner.floor)
    return Answer(places, pose, max(0.0, min(1.0, share)))


def _similarity_sums(matches: Sequence[Sequence[Match]]) -> dict[PlaceOrdinal, float]:
    """Sum of similarities by Place; summed exactly, so that no order matters."""
    given: dict[PlaceOrdinal, list[float]] = {}
    for row in matches:
        for match in row[:PLAIN_NEIGHBOURS]:
            if match.object_place is not None:
                given.setdefault(match.object_place, []).append(match.similarity)
    return {place: math.fsum(values) for place, values in given.items()}


def _spread(candidates: MapCandidates, place: PlaceOrdinal, x: float, y: float) -> float:
    """Root mean square distance from (x, y) of the poses whose matches support the place."""
    squared = [
        (m.pose[0] - x) ** 2 + (m.pose[1] - y) ** 2
        for row in candidates.matches
        for m in row[:PLAIN_NEIGHBOURS]
        if m.object_place == place and m.pose is not None
    ]
    return math.sqrt(math.fsum(squared) / len(squared)) if squared else 0.0
