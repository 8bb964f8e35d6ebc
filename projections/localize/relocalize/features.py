"""Features of a posterior, and its confidence: a logistic model of them.

`confidence` is the probability that the pose is within 1.5 m of the truth. In the fit, an answer to
crops of things that the map lacks counts as wrong. Where only classes are known, there is no
likeness by which to decide whether the things are those of the map; `confidence` is then the
posterior's weight near the answer, which assumes that they are.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np

from projections.fold.settings import LocalizerConstants

from .camera import Floats
from .landmarks import Landmarks
from .likelihood import unexplained
from .model import Model

_ELSEWHERE_M: Final = 2.5
_MOST_MARGIN: Final = 0.5
WEIGHTS: Final = (-10.01, 18.17, 1.607, -0.882, -2.168, -0.407, 0.406)
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
    model: Model,
) -> Features:
    """The features of a posterior. ``crops`` are the log-likelihoods of crops with evidence,
    ``landmarks`` those of crops that have an embedding too; ``asked`` counts all crops."""
    missing = (asked - len(crops)) * unexplained(model)
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
        return min(features.mass, 1.0)
    return _logistic(WEIGHTS, features, constants.confidence_scale, constants.confidence_shift)


def _logistic(weights: Sequence[float], features: Features, scale: float, shift: float) -> float:
    score = weights[0] + math.fsum(
        weight * value for weight, value in zip(weights[1:], astuple(features), strict=True)
    )
    score = scale * score + shift
    return 1.0 / (1.0 + math.exp(-max(-40.0, min(40.0, score))))
