"""Certainty of an answer: `known`, the probability that the map has the things shown, `confidence`,
that the pose is within 1.5 m of the truth, and `thinness`, what the map has too little of for
reliable probabilities.

`known` and `confidence` are logistic models. Their inputs depend neither on the embedding model nor
on the size of the map: likenesses are relative, (cosine - different) / (1 - different), 0 for what
different things of this map look like to each other and 1 for the same picture. A thing seen again
on another day has some 0.75, the most similar of a building that was never mapped 0.2 to 0.4, or
0.7 where it has furniture of the same model.

The weights are for all maps; `scripts/fit_confidence` fits them. How far a map is off is in its
`LocalizerConstants`: a shift and a scale of the logit, which `mapfold calibrate` reads off the
map's own questions.

Nothing measured on other maps holds for one that a robot has just begun: the few things it has seen
are the most similar to any crop, and every pose is near the few spots they were seen from. The
candidates show that, so `thinness` costs a question nothing.

In the fit of `confidence`, an answer to crops of things that the map lacks counts as wrong. Where
only classes are known, there is no likeness by which to decide whether the things are those of the
map: `known` is one half. The posterior's weight near the answer assumes that they are, and is too
large; `confidence` is half its square, which was chosen on generated buildings
(docs/decisions/relocalization.md).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np

from eventsrc.base.text import counted
from projections.fold.exact import exp
from projections.fold.settings import LocalizerConstants

from .camera import Floats
from .candidates import NEIGHBOURS, Match
from .constants import MapConstants, RankingModel
from .landmarks import Landmarks
from .question import QuestionCrop

UNKNOWN_BELOW: Final = 0.5
"""Below this probability of `known` the answer is 'unknown'."""
KNOWN_WEIGHTS: Final[tuple[float, ...]] = (-15.095, 19.053, 4.775, 10.356, -1.612)
"""Intercept, then one for each of `known_features`."""
_NEAREST: Final = 4
_LEAST: Final = 0.4
"""Least likeness in the means over the crops: a lower one counts as this."""
_NO_LOOK: Final = 0.5
"""`known` of a question whose crops have no embedding: their classes are in the map."""


def known_probability(
    crops: Sequence[QuestionCrop], matches: Sequence[Sequence[Match]], constants: MapConstants
) -> float:
    """The probability that the map has one of the things shown; ``matches`` run parallel to
    ``crops``, each row most similar first. 0 where nothing is similar to any crop."""
    features = known_features(crops, matches, constants)
    if features is None:
        return _NO_LOOK if any(matches) else 0.0
    localizer = constants.localizer
    logit = logit_of(KNOWN_WEIGHTS, features)
    return probability(logit, localizer.known_scale, localizer.known_shift)


def known_features(
    crops: Sequence[QuestionCrop], matches: Sequence[Sequence[Match]], constants: MapConstants
) -> tuple[float, ...] | None:
    """The greatest relative likeness of any crop to an observation, and the mean over the crops of
    each crop's greatest. Then, of each crop's mean likeness to its four most similar observations:
    by how much the mean over the crops is below the greatest, and the second greatest; both are 0
    for one crop. In all but the first a likeness counts as at least 0.4. None if no crop has an
    embedding and matches."""
    zero, localizer = constants.different, constants.localizer
    best, mean = [], []
    for crop, row in zip(crops, matches, strict=True):
        if crop.vector is None or not row:
            continue
        shift = localizer.text_shift if crop.is_text else 0.0
        likeness = [(m.similarity + shift - zero) / (1.0 - zero) for m in row[:_NEAREST]]
        best.append(min(likeness[0], 1.0))
        mean.append(min(math.fsum(likeness) / len(likeness), 1.0))
    if not best:
        return None
    alike = sorted((max(each, _LEAST) for each in mean), reverse=True)
    return (
        max(best),
        math.fsum(max(each, _LEAST) for each in best) / len(best),
        math.fsum(alike) / len(alike) - alike[0],
        alike[min(1, len(alike) - 1)] - alike[0],
    )


def logit_of(weights: Sequence[float], features: Sequence[float]) -> float:
    """The logit of a logistic model: the intercept ``weights[0]`` plus the weighted features."""
    return weights[0] + math.fsum(
        weight * value for weight, value in zip(weights[1:], features, strict=True)
    )


def probability(logit: float, scale: float = 1.0, shift: float = 0.0) -> float:
    """The logistic function of a logit, corrected by a map's own scale and shift; the same bits on
    every machine."""
    return 1.0 / (1.0 + exp(-max(-40.0, min(40.0, scale * logit + shift))))


LEAST_SPOTS: Final = 5
"""Least number of robot positions among the candidates; with fewer the robot has only looked
around."""
SPOT_M: Final = 0.35


def thinness(crops: Sequence[QuestionCrop], matches: Sequence[Sequence[Match]]) -> str | None:
    """A clause that names what the map has too little of; None if it has enough or no crop has an
    embedding.

    A map is thin with fewer observations than are fetched for one crop, or if those that are were
    made from fewer than five spots.
    """
    rows = [row for crop, row in zip(crops, matches, strict=True) if crop.vector is not None]
    if not rows:
        return None
    seen = {match.observation: match for row in rows for match in row}
    few = max(len(row) for row in rows) < NEIGHBOURS
    spots = _spots(seen[ordinal] for ordinal in sorted(seen))
    if not few and spots >= LEAST_SPOTS:
        return None
    number = counted(len(seen), "observation") if few else "its most similar observations"
    where = counted(spots, "spot") if spots < LEAST_SPOTS else f"{LEAST_SPOTS} spots or more"
    return f"{number} from {where}"


def _spots(matches: Iterable[Match]) -> int:
    """The number of distinct robot positions of the matches, counted up to `LEAST_SPOTS`."""
    spots: list[tuple[float, float]] = []
    for match in matches:
        if match.pose is None:
            continue
        x, y = match.pose[:2]
        for a, b in spots:
            if math.hypot(x - a, y - b) < SPOT_M:
                break
        else:
            spots.append((x, y))
            if len(spots) == LEAST_SPOTS:
                break
    return len(spots)


_ELSEWHERE_M: Final = 2.5
_MOST_MARGIN: Final = 0.5
CONFIDENCE_WEIGHTS: Final = (-10.01, 18.17, 1.607, -0.882, -2.168, -0.407, 0.406)
"""Intercept, then one for each of `Features`."""


@dataclass(frozen=True, slots=True)
class Features:
    """``likeness`` is the greatest relative likeness of any crop's match, ``margin`` what it is
    above that of a landmark more than 2.5 m away, the greatest of any crop and at most 0.5. Crops
    of which only the class is known do not count; without any other both are None.

    ``mass`` is the weight within 1.5 m of the answer, ``loss`` the expected error in metres, 2.5 m
    at most. ``best_crop`` and ``mean_crop`` are log-likelihood ratios of the crops at the likeliest
    pose; a crop without evidence counts as explained by nothing.
    """

    likeness: float | None
    margin: float | None
    mass: float
    loss: float
    best_crop: float
    mean_crop: float


def features_of(
    landmarks: Sequence[Landmarks],
    crops: Floats,
    asked: int,
    mass: float,
    loss: float,
    model: RankingModel,
) -> Features:
    """The features of a posterior. ``crops`` are the log-likelihoods of crops with evidence,
    ``landmarks`` those of crops that have an embedding too; ``asked`` counts all crops."""
    missing = (asked - len(crops)) * math.log(1.0 - model.in_map)  # their things are not in the map
    return Features(
        max((float(each.likeness.max()) for each in landmarks), default=None),
        max((_margin(each) for each in landmarks), default=None),
        mass,
        loss,
        float(crops.max()),
        (float(crops.sum()) + missing) / asked,
    )


def _margin(landmarks: Landmarks) -> float:
    best = int(np.argmax(landmarks.likeness))
    dx, dy = (landmarks.xy - landmarks.xy[best]).T
    others = landmarks.likeness[dx * dx + dy * dy > _ELSEWHERE_M * _ELSEWHERE_M]
    if not len(others):
        return _MOST_MARGIN
    return min(_MOST_MARGIN, float(landmarks.likeness[best]) - float(others.max()))


def confidence_of(features: Features, constants: LocalizerConstants) -> float:
    """The probability that the pose is within 1.5 m."""
    if features.likeness is None:
        mass = min(features.mass, 1.0)
        return _NO_LOOK * mass * mass
    logit = logit_of(CONFIDENCE_WEIGHTS, astuple(features))
    score = constants.confidence_scale * logit + constants.confidence_shift
    return 1.0 / (1.0 + math.exp(-max(-40.0, min(40.0, score))))
