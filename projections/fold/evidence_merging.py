"""Merging of Objects by evidence: pairs that further observations show to be one thing.

An Object is compared with those around it each time it has half as many more observations. Two
are one while the evidence is above 0: of their estimates (χ² of the difference, against anywhere in
9 m²), of their looks (the mean over all pairs of exemplars, each within ±6), and half of that of
their labels; unless more than a tenth of the pictures of one show both, or a command keeps them
apart. Of several the one with the most evidence is taken, of equal ones that founded first.

A thing that was moved may also be turned, so the sides seen at one position cannot be compared with
those at the other. Of two such things (`turned_looks`) the ratio is taken for `_TURNS` angles
between them, times √(m · n) for m and n exemplars instead of the mean's 1 / (m · n), since pairs of
few exemplars are no independent evidence. The likelihoods of all angles are averaged. A pair that
is less alike than things of different classes counts as those.

Means are of integers; √ and +, −, ×, ÷ in one order make the rest bit-exact.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from eventsrc.envelope.model import DetId

from .deltas import MergeEvidence, ObjectOrdinal
from .exact import exp, log, log_of
from .looks import LookRatios, LookScale
from .pair_groups import PairGroups
from .spots import COMMON_M2
from .thing_index import ThingIndex
from .things import INVERSE, LABEL_WEIGHT, RUN, SIDE_COS, SIDE_SIN, FusedThing, LabelCounts

_LOG_AREA = log(9.0) - 1.8378770664093453
"""log(9 m² / 2π)."""
_WORST_CHI2 = 40.0
_LEAST_GEOMETRY = -3.0
_FARTHEST_CHI2 = 2.0 * (_LOG_AREA - _LEAST_GEOMETRY) - 2.0 * log(2.0 * COMMON_M2) + 0.1
"""An upper bound of χ² for pairs of estimates with enough evidence: the variance of their
difference is at least twice the common one in every direction."""
_SHARE_OF_PICTURES = 10
_WITHOUT_LOOKS = -1.0, 1.0
"""The ratio that stands for that of the looks where one has none, by whether the labels agree."""
_MOST_PER_PAIR = 6.0
_UNIT = 1 << 20


class _Candidate(NamedTuple):
    """An Object that may be the same thing: the number of pictures with both, the evidence of the
    estimates, and their squared distance in m²."""

    ordinal: ObjectOrdinal
    thing: FusedThing
    both: int
    geometry: float
    far2: float


class Merging:
    """Finds partners."""

    def __init__(
        self,
        index: ThingIndex,
        look_ratios: LookRatios,
        scale: LookScale,
        labels: LabelCounts,
        groups: PairGroups[DetId] | None,
    ) -> None:
        self._index = index
        self._look_ratios = look_ratios
        self._scale = scale
        self._labels = labels
        self._groups = groups

    def partner_of(self, ordinal: ObjectOrdinal) -> tuple[ObjectOrdinal, MergeEvidence] | None:
        """The Object to merge with, and the evidence; None if there is none. To be called when the
        Object has ``checked`` observations or more."""
        thing = self._index.thing(ordinal)
        thing.checked = thing.count + 1 + thing.count // 2
        candidates: list[_Candidate] = []
        for partner in self._around(thing):
            if partner == ordinal:
                continue
            other = self._index.thing(partner)
            both = thing.met.get(partner, 0)
            if both * _SHARE_OF_PICTURES > min(thing.count, other.count):
                continue
            if self._groups is not None and self._groups.are_apart(thing.groups, other.groups):
                continue
            geometry, far2 = _geometry(thing, other)
            if geometry > _LEAST_GEOMETRY:
                candidates.append(_Candidate(partner, other, both, geometry, far2))
        if not candidates:
            return None
        best: tuple[float, ObjectOrdinal, MergeEvidence] | None = None
        looks = self._looks(thing, [candidate.thing for candidate in candidates])
        for (partner, other, both, geometry, far2), look in zip(candidates, looks, strict=True):
            value = look + geometry
            if value > 0.0 and (best is None or value > best[0]):
                evidence = MergeEvidence(
                    round(look * 1000.0),
                    round(geometry * 1000.0),
                    round(math.sqrt(far2) * 1e6),
                    both,
                    thing.count + other.count - both,
                )
                best = value, partner, evidence
        return None if best is None else best[1:]

    def _around(self, thing: FusedThing) -> list[ObjectOrdinal]:
        """A superset of the Objects within reach that could pass the test of χ²."""
        x, y, xx, _, yy, *_ = thing.where()
        listed = self._index.listed(x, y)
        estimates = self._index.estimates.take(listed, axis=0).T
        dx, dy = estimates[0] - x, estimates[1] - y
        far2 = dx * dx + dy * dy
        near = far2 < (estimates[2] + estimates[4] + (xx + yy)) * _FARTHEST_CHI2
        near &= far2 <= self._index.reach_m * self._index.reach_m
        around: list[ObjectOrdinal] = listed[near].tolist()
        return around

    def _looks(self, one: FusedThing, others: list[FusedThing]) -> list[float]:
        """The log-likelihood ratio that a thing and each of several others are one, by looks (the
        mean over pairs of exemplars) and labels. The others' exemplars are columns of one
        matrix."""
        looked = [bool(one.marks and other.marks) for other in others]
        if not all(looked):
            alike = [other for other, is_one in zip(others, looked, strict=True) if is_one]
            values = iter(self._looks(one, alike) if alike else ())
            return [
                next(values) if is_one else self._without_looks(one, other)
                for other, is_one in zip(others, looked, strict=True)
            ]
        counts = [len(other.marks) for other in others]
        agree = [_labels_agree(one, other) for other in others]
        a = np.array(one.by_row())
        b = np.array([mark for other in others for mark in other.by_row()])
        looks = np.concatenate([other.looks[: len(other.marks)] for other in others])
        dots = (one.looks[: len(one.marks)] @ looks.T).astype(np.float64)
        cosines = dots * a[:, INVERSE, np.newaxis] * b[:, INVERSE]
        different = self._scale.different()
        ratios = self._look_ratios.ratios(
            (cosines - different) * (1.0 / (1.0 - different)),
            a[:, SIDE_COS, np.newaxis] * b[:, SIDE_COS]
            + a[:, SIDE_SIN, np.newaxis] * b[:, SIDE_SIN],
            a[:, RUN, np.newaxis] != b[:, RUN],
            np.array(agree).repeat(counts),
        )
        ratios = np.maximum(np.minimum(ratios, _MOST_PER_PAIR), -_MOST_PER_PAIR)
        sums = np.rint(ratios * _UNIT).astype(np.int64).sum(axis=0)  # exact: integers
        found: list[float] = []
        first = 0
        for other, count in zip(others, counts, strict=True):
            total = int(sums[first : first + count].sum())
            mean = total / (len(one.marks) * count * _UNIT)
            found.append(mean + self._by_labels(one, other))
            first += count
        return found

    def _without_looks(self, one: FusedThing, other: FusedThing) -> float:
        """`_looks` of a pair of which one has no look."""
        return _WITHOUT_LOOKS[_labels_agree(one, other)] + self._by_labels(one, other)

    def _by_labels(self, one: FusedThing, other: FusedThing) -> float:
        """The part of the labels in `_looks`."""
        labels = 0.0
        for label, count in other.classes.items():
            labels += count * self._labels.ratio(one, label, self._labels.usual(label))
        return LABEL_WEIGHT * labels / other.count


def _labels_agree(one: FusedThing, other: FusedThing) -> bool:
    """Whether the class of one is among the labels of the other."""
    return other.class_name in one.classes or one.class_name in other.classes


def _geometry(thing: FusedThing, other: FusedThing) -> tuple[float, float]:
    """The log-likelihood ratio of two estimates being of one thing, and their squared distance in
    m²."""
    x, y, xx, xy, yy, *_ = thing.where()
    other_x, other_y, a, b, c, *_ = other.where()
    dx, dy, a, b, c = other_x - x, other_y - y, a + xx, b + xy, c + yy
    det = a * c - b * b
    chi2 = (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / det
    geometry = min(chi2, _WORST_CHI2) * -0.5 - 0.5 * log_of(det) + _LOG_AREA
    return geometry, dx * dx + dy * dy


_HALF = 0.7071067811865476
_TURNS = 8
_COS = np.array([1.0, _HALF, 0.0, -_HALF, -1.0, -_HALF, 0.0, _HALF])[:, np.newaxis, np.newaxis]
_SIN = np.array([0.0, _HALF, 1.0, _HALF, 0.0, -_HALF, -1.0, -_HALF])[:, np.newaxis, np.newaxis]
_MOST_PER_PAIR = 6.0
_UNIT = 1 << 20


def turned_looks(
    one: FusedThing, others: Sequence[FusedThing], look_ratios: LookRatios, scale: LookScale
) -> list[float]:
    """The logarithm of the ratio for a thing and each of several others of its class, all with
    exemplars: those of the others are columns of one matrix."""
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
