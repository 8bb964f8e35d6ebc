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

How much likeness another day costs, a map of one run cannot know. Its `SessionPrior` is a mean and
a spread of that, as an addition to the logit; of several runs `mapfold calibrate` reads it. What
the questions of one session say of it is in `QuestionSession`.

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
from .constants import MapConstants, RankingModel, SessionPrior
from .landmarks import Landmarks
from .question import QuestionCrop

UNKNOWN_BELOW: Final = 0.5
"""Below this probability of `known` the answer is 'unknown'."""
KNOWN_WEIGHTS: Final[tuple[float, ...]] = (-15.095, 19.053, 4.775, 10.356, -1.612)
"""Intercept, then one for each of `known_features`."""
_NEAREST: Final = 4
_LEAST: Final = 0.4
"""Least likeness in the means over the crops: a lower one counts as this."""
_LEAST_KNOWN: Final = 1e-12
_NO_LOOK: Final = 0.5
"""`known` of a question whose crops have no embedding: their classes are in the map."""


@dataclass(frozen=True, slots=True)
class Looks:
    """What the likenesses of a question say: the logit of `known` as of a day that costs what
    things of the weights' fit lost, and the prior of what this one costs beside."""

    logit: float
    prior: SessionPrior

    @property
    def known(self) -> float:
        """The probability that the map has one of the things shown, of a question alone."""
        return probability(self.logit + self.prior.mean)


def known_probability(looks: Looks | None, matches: Sequence[Sequence[Match]]) -> float:
    """The probability that the map has one of the things shown; 0 where nothing is similar to any
    crop."""
    if looks is None:
        return _NO_LOOK if any(matches) else 0.0
    return looks.known


def looks_of(
    crops: Sequence[QuestionCrop], matches: Sequence[Sequence[Match]], constants: MapConstants
) -> Looks | None:
    """What the likenesses say; ``matches`` run parallel to ``crops``, each row most similar first.
    None if no crop has an embedding and matches."""
    features = known_features(crops, matches, constants)
    if features is None:
        return None
    localizer = constants.localizer
    logit = localizer.known_scale * logit_of(KNOWN_WEIGHTS, features) + localizer.known_shift
    return Looks(logit, constants.session)


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


_SHARES: Final = np.array((0.02, 0.1, 0.3, 0.5, 0.7, 0.85, 0.95))
_STRANGE: Final = 0.35
"""Shares of a session's questions that are known, and the prior of the least: the robot is in
another building, or in a part that was never mapped."""
_COSTS: Final = np.linspace(-4.0, 4.0, 17)
"""How much lower than expected the logits of known questions are in a session."""
_KNOWN_LOGIT, _KNOWN_SPREAD = 2.4, 1.6
_OTHER_LOGIT, _OTHER_SPREAD = -4.0, 2.6
_LOOK_ALIKES: Final = 0.06
"""Logits of known and of unknown questions, and the share of unknown ones that look like known
ones."""
_COUNT: Final = 0.3
"""How much of an independent question each is: successive ones show the same things."""


class QuestionSession:
    """What the questions of one session say of what its day costs.

    Their logits are a mixture: known ones are normally distributed about 2.4 less the cost of the
    session, and flat above; the others are far below, but for a few look-alikes. The weights of a
    grid of costs and of shares of known questions are multiplied by the likelihood of each
    question. As long as there is none, a question is answered as alone.
    """

    def __init__(self) -> None:
        self._prior: Floats | None = None
        self._weights: Floats = np.zeros(0)

    def known(self, looks: Looks) -> tuple[float, float]:
        """`known` of a question by those before it, and its standard deviation, as the cost of the
        session is uncertain."""
        weights, prior = (self._weights, self._prior)
        if prior is None:
            weights = prior = _session_prior(looks.prior.spread)
        logit = looks.logit + looks.prior.mean
        ratios = _known_ratios(logit)
        usual = _mean_ratio(ratios, prior)
        known = probability(logit + math.log(_mean_ratio(ratios, weights) / usual))
        by_cost = np.exp(weights - weights.max()).sum(1)
        each = [
            probability(logit + math.log(_mean_ratio(row[None], own[None]) / usual))
            for row, own in zip(ratios, weights, strict=True)
        ]
        off = np.array(each) - known
        return known, math.sqrt(float(by_cost @ (off * off) / by_cost.sum()))

    def add(self, looks: Looks) -> None:
        """Take in a question."""
        if self._prior is None:
            self._weights = self._prior = _session_prior(looks.prior.spread)
        same, other = _densities(looks.logit + looks.prior.mean)
        likelihood = _SHARES * same[:, None] + (1.0 - _SHARES) * other[:, None]
        self._weights = self._weights + _COUNT * np.log(likelihood)


def _session_prior(spread: float) -> Floats:
    """Log weights by cost and share."""
    costs = -0.5 * (_COSTS / spread) ** 2
    others = (1.0 - _STRANGE) / (len(_SHARES) - 1)
    shares = np.array([_STRANGE] + [others] * (len(_SHARES) - 1))
    prior: Floats = costs[:, None] + np.log(shares)
    return prior


def _densities(logit: float) -> tuple[Floats, Floats]:
    """The densities of the logit of a known question and of another one, by cost."""
    usual = _KNOWN_LOGIT - _COSTS
    same = np.exp(-0.5 * ((np.minimum(logit, usual) - usual) / _KNOWN_SPREAD) ** 2) / _KNOWN_SPREAD
    above = max(logit, _OTHER_LOGIT) - _OTHER_LOGIT
    other = math.exp(-0.5 * (above / _OTHER_SPREAD) ** 2) / _OTHER_SPREAD
    return same, (1.0 - _LOOK_ALIKES) * other + _LOOK_ALIKES * same


def _known_ratios(logit: float) -> Floats:
    """Probabilities of being known, by cost and share."""
    same, other = _densities(logit)
    known = _SHARES * same[:, None]
    found: Floats = known / (known + (1.0 - _SHARES) * other[:, None])
    return found


def _mean_ratio(known: Floats, weights: Floats) -> float:
    """The odds of the mean probability under log weights."""
    shares = np.exp(weights - weights.max())
    mean = min(max(float((shares * known).sum() / shares.sum()), _LEAST_KNOWN), 1.0 - _LEAST_KNOWN)
    return mean / (1.0 - mean)


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
