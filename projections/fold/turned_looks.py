"""The log-likelihood ratio of the looks of two things that may be one, turned by an unknown angle.

A thing that was moved may also be turned, so the sides seen at one position cannot be compared with
those at the other. Of two things the ratio of likelihoods (`looks`) is taken for `_TURNS` angles
between them: the mean of the logarithms over all pairs of exemplars, each within ±`_MOST_PER_PAIR`,
times √(m · n) for m and n exemplars, since pairs of few exemplars are no independent evidence. The
likelihoods of all angles are averaged. A pair that is less alike than things of different classes
counts as those.

The mean is that of integers; √ and +, −, ×, ÷ in one order make the rest bit-exact.
"""

import math
from collections.abc import Sequence

import numpy as np

from .exact_functions import exp, log
from .looks import LookRatios, LookScale
from .things import INVERSE, RUN, SIDE_COS, SIDE_SIN, Thing

_HALF = 0.7071067811865476
_TURNS = 8
_COS = np.array([1.0, _HALF, 0.0, -_HALF, -1.0, -_HALF, 0.0, _HALF])[:, np.newaxis, np.newaxis]
_SIN = np.array([0.0, _HALF, 1.0, _HALF, 0.0, -_HALF, -1.0, -_HALF])[:, np.newaxis, np.newaxis]
_MOST_PER_PAIR = 6.0
_UNIT = 1 << 20


def turned_looks(
    one: Thing, others: Sequence[Thing], look_ratios: LookRatios, scale: LookScale
) -> list[float]:
    """The logarithm of the ratio for a thing and each of several others of its class: their
    exemplars are columns of one matrix."""
    if not others:
        return []
    own, counts = len(one.marks), [len(other.marks) for other in others]
    a = np.array(one.by_row())
    b = np.array([mark for other in others for mark in other.by_row()])
    looks = np.concatenate([other.looks[: len(other.marks)] for other in others])
    dots = (one.looks[:own] @ looks.T).astype(np.float64)
    cosines = dots * a[:, INVERSE, np.newaxis] * b[:, INVERSE]
    different = scale.different()
    a_cos, a_sin = a[:, SIDE_COS, np.newaxis], a[:, SIDE_SIN, np.newaxis]
    cos = a_cos * b[:, SIDE_COS] + a_sin * b[:, SIDE_SIN]
    sin = a_cos * b[:, SIDE_SIN] - a_sin * b[:, SIDE_COS]
    likeness = (cosines - different) * (1.0 / (1.0 - different))
    ratios = look_ratios.ratios(
        np.maximum(likeness, 0.0),
        cos * _COS - sin * _SIN,
        a[:, RUN, np.newaxis] != b[:, RUN],
        np.ones(len(b), np.bool_),
    )
    ratios = np.maximum(np.minimum(ratios, _MOST_PER_PAIR), -_MOST_PER_PAIR)
    sums = np.rint(ratios * _UNIT).astype(np.int64).sum(axis=1)  # exact: integers
    firsts = np.cumsum([0, *counts[:-1]])
    totals: list[list[int]] = np.add.reduceat(sums, firsts, axis=1).T.tolist()
    return [
        _mean_likelihood([total / (_UNIT * math.sqrt(own * count)) for total in turns])
        for turns, count in zip(totals, counts, strict=True)
    ]


def _mean_likelihood(ratios: Sequence[float]) -> float:
    """The logarithm of the mean of numbers given as logarithms."""
    most = max(ratios)
    total = 0.0
    for ratio in ratios:
        total += exp(ratio - most)
    return most + log(total / len(ratios))
