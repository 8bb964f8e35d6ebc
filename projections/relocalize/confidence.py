"""How sure: a logistic model on a few features of the posterior.

``confidence`` estimates the probability that the pose hypothesis is within 1.5 m (the default ε) of
the truth, counting a robot that is somewhere the map does not know as never right. The weights come
from `scripts/fit_confidence`, which fits them on generated buildings; the runs reported in
docs/relocalization.md were not used.
"""

import math
from typing import Final

from .posterior import Posterior

UNKNOWN_BELOW: Final = 0.3
"""Below this confidence the answer is 'unknown'."""

WEIGHTS: Final[tuple[float, ...]] = (-6.144, 0.159, 0.105, 0.740, 4.466, -0.776)
"""Intercept, then one weight for each of `features`."""


_MOST: Final = 7.0
"""A crop explains no more than this; keeps one lucky feature from deciding alone."""


def features(posterior: Posterior, crops: int) -> tuple[float, ...]:
    """What the confidence depends on; ``crops`` counts all crops asked with, at least 1."""
    shares = (*posterior.shares, 0.0, 0.0)
    return (
        min(shares[0], _MOST),
        min(shares[1], _MOST),
        min(posterior.total / crops, _MOST),
        posterior.mass,
        posterior.expected_error_m,
    )


def confidence(posterior: Posterior, crops: int) -> float:
    """A probability in 0 … 1."""
    score = WEIGHTS[0] + math.fsum(
        weight * value
        for weight, value in zip(WEIGHTS[1:], features(posterior, crops), strict=True)
    )
    return 1.0 / (1.0 + math.exp(-max(-40.0, min(40.0, score))))
