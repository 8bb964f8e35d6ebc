"""The ranking: from crops and their candidates to an answer. Pure: no clock, no chance, no I/O.

The joint method weighs poses (`posterior`), and a Place's score is the share of their weight that
lies in it: each hypothesis counts for the Place of the nearest keyframe among the candidates.
Places that no hypothesis lies in come last, by the plain recipe's sums. Ties go to the Place
founded first. Crops are put into one order at the start, so that theirs does not matter.
"""

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from .answer import Answer, PoseHypothesis
from .camera import Camera
from .candidates import Candidates, Match
from .confidence import confidence
from .crops import Crop
from .evidence import ranked_places
from .model import MODEL, Model
from .plain import plain_scores, rank_plain
from .posterior import Posterior, locate
from .sighting import sightings

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
