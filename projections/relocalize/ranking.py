"""The ranking: from crops and their candidates to an answer. Pure: no clock, no chance, no I/O.

The joint method weighs poses (`posterior`), and a Place's score is the share of their weight that
lies in it: each hypothesis counts for the Place of the nearest keyframe among the candidates.
Places that no hypothesis lies in come last, by the plain recipe's sums. Ties go to the Place
founded first. Crops are put into one order at the start, so that theirs does not matter.

Places in their order, each with the observations that speak for it: the best one per crop.

The plain recipe, kept as the baseline everything else is measured against.

The ten nearest observations of each crop; each gives its similarity to the Place of its Object; the
Place with the greatest sum wins; the pose is its centroid.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np

from .answer import Answer, Evidence, PoseHypothesis, RankedPlace
from .camera import Camera
from .candidates import Candidates, Match
from .model import MODEL, Model
from .pose import Posterior, confidence, locate
from .question import Crop
from .sighting import sightings


def ranked_places(
    candidates: Candidates, order: Sequence[int], scores: Mapping[int, float]
) -> tuple[RankedPlace, ...]:
    """The places of ``order`` (ordinals) with their scores and evidence."""
    ranked = []
    for place in order:
        spot = candidates.places[place]
        evidence = _evidence(candidates.matches, place)
        ranked.append(RankedPlace(spot.place_id, scores[place], spot.x, spot.y, evidence))
    return tuple(ranked)


def _evidence(matches: Sequence[Sequence[Match]], place: int) -> tuple[Evidence, ...]:
    best = [next((m for m in row if speaks_for(m, place)), None) for row in matches]
    found = sorted((m for m in best if m is not None), key=lambda m: (-m.similarity, m.observation))
    return tuple(Evidence(m.det_id, m.object_id, m.class_name, m.similarity) for m in found)


def speaks_for(match: Match, place: int) -> bool:
    """Whether the match's Object is located in the place, or was seen from it."""
    return place in (match.object_place, match.keyframe_place)


PLAIN_NEIGHBOURS = 10


def plain_scores(matches: Sequence[Sequence[Match]]) -> dict[int, float]:
    """Sum of similarities by Place; summed exactly, so that no order matters."""
    given: dict[int, list[float]] = {}
    for row in matches:
        for match in row[:PLAIN_NEIGHBOURS]:
            if match.object_place is not None:
                given.setdefault(match.object_place, []).append(match.similarity)
    return {place: math.fsum(values) for place, values in given.items()}


def rank_plain(candidates: Candidates, top: int) -> Answer:
    """The plain recipe's answer. Its confidence is the winner's share of all similarity."""
    scores = plain_scores(candidates.matches)
    if not scores:
        return Answer((), None, 0.0)
    order = sorted(scores, key=lambda place: (-scores[place], place))
    winner = candidates.places[order[0]]
    share = scores[order[0]] / math.fsum(scores.values())
    places = ranked_places(candidates, order[:top], scores)
    spread = _spread(candidates, order[0], winner.x, winner.y)
    return Answer(
        places, PoseHypothesis(winner.x, winner.y, None, spread), max(0.0, min(1.0, share))
    )


def _spread(candidates: Candidates, place: int, x: float, y: float) -> float:
    """Root mean square distance of the poses that voted for the place from its centroid."""
    squared = [
        (m.pose[0] - x) ** 2 + (m.pose[1] - y) ** 2
        for row in candidates.matches
        for m in row[:PLAIN_NEIGHBOURS]
        if m.object_place == place and m.pose is not None
    ]
    return math.sqrt(math.fsum(squared) / len(squared)) if squared else 0.0


Method = Literal["joint", "plain"]
DEFAULT_CAMERA: Final = Camera()


def rank(
    crops: Sequence[Crop],
    candidates: Candidates,
    *,
    top: int = 3,
    method: Method = "joint",
    camera: Camera = DEFAULT_CAMERA,
    model: Model = MODEL,
) -> Answer:
    """The answer to a question; ``candidates.matches`` run parallel to ``crops``."""
    order = sorted(range(len(crops)), key=lambda index: crops[index].order)
    crops = [crops[index] for index in order]
    candidates = Candidates(tuple(candidates.matches[i] for i in order), candidates.places)
    if method == "plain":
        return rank_plain(candidates, top)
    posterior = weigh(crops, candidates, camera, model)
    return _answer(candidates, posterior, len(crops), top)


def weigh(
    crops: Sequence[Crop], candidates: Candidates, camera: Camera, model: Model
) -> Posterior | None:
    """The posterior over poses; None when no candidate is relevant."""
    seen = sightings(crops, candidates.matches, camera, model)
    return locate(seen, model) if seen else None


def _answer(candidates: Candidates, posterior: Posterior | None, crops: int, top: int) -> Answer:
    plain = plain_scores(candidates.matches)
    shares = {} if posterior is None else _shares(candidates, posterior)
    known = sorted(shares.keys() | plain.keys())
    order = sorted(known, key=lambda p: (-shares.get(p, 0.0), -plain.get(p, 0.0), p))
    scores = {place: shares.get(place, 0.0) for place in known}
    places = ranked_places(candidates, order[:top], scores)
    if posterior is None:
        return Answer(places, None, 0.0)
    pose = PoseHypothesis(posterior.x, posterior.y, posterior.yaw, posterior.spread_m)
    return Answer(places, pose, confidence(posterior, crops))


def _shares(candidates: Candidates, posterior: Posterior) -> dict[int, float]:
    """The weight of the hypotheses by the Place of the nearest placed candidate keyframe."""
    placed = sorted({spot for row in candidates.matches for m in row if (spot := _placed(m))})
    if not placed:
        return {}
    where = np.array([spot[:2] for spot in placed])
    dx = posterior.poses[:, 0][:, None] - where[None, :, 0]
    dy = posterior.poses[:, 1][:, None] - where[None, :, 1]
    nearest = np.argmin(dx * dx + dy * dy, axis=1)
    owners = np.array([spot[2] for spot in placed])[nearest]
    return {
        int(place): float(posterior.weights[owners == place].sum()) for place in np.unique(owners)
    }


def _placed(match: Match) -> tuple[float, float, int] | None:
    place = match.object_place if match.keyframe_place is None else match.keyframe_place
    if match.pose is None or place is None:
        return None
    return match.pose[0], match.pose[1], place
