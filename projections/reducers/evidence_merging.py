"""Which Object turns out to be the same as another, now that it was seen better.

An Object is compared with those around it each time it has half as many more observations. Two
are one while the evidence is above 0: of their estimates (χ² of the difference, against anywhere in
9 m²), of their looks (the mean over all pairs of exemplars, each within ±6), and half of that of
their labels; unless more than a tenth of the pictures of one show both, or a command keeps them
apart. Of several the one with the most evidence is taken, of equal ones that founded first.
"""

import math

import numpy as np

from eventsrc.envelope import DetId
from projections.deltas import MergeEvidence, ObjectOrdinal
from projections.exact_functions import log
from projections.pair_groups import PairGroups

from .agreement import logs
from .label_counts import LABEL_WEIGHT, LabelCounts
from .looks import LookRatios, LookScale
from .thing_index import ThingIndex
from .things import INVERSE, RUN, SIDE_COS, SIDE_SIN, Thing

_LOG_AREA = log(9.0) - 1.8378770664093453
"""log(9 m² / 2π)."""
_WORST_CHI2 = 40.0
_LEAST_GEOMETRY = -3.0
_SHARE_OF_PICTURES = 10
_MOST_PER_PAIR = 6.0
_UNIT = 1 << 20


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
        """The Object that is the same, and why; None if there is none or no search is due."""
        thing = self._index.thing(ordinal)
        if thing.count < thing.checked:
            return None
        thing.checked = thing.count + 1 + thing.count // 2
        x, y, xx, xy, yy = self._index.estimates[:5, ordinal].tolist()
        near = self._index.near(x, y)
        near = near[near != ordinal]
        if not len(near):
            return None
        others = self._index.estimates[:5, near]
        dx, dy = others[0] - x, others[1] - y
        a, b, c = others[2] + xx, others[3] + xy, others[4] + yy
        det = a * c - b * b
        chi2 = (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / det
        geometry = np.minimum(chi2, _WORST_CHI2) * -0.5 - 0.5 * logs(det) + _LOG_AREA
        kept = (geometry > _LEAST_GEOMETRY).nonzero()[0]
        candidates: list[tuple[int, ObjectOrdinal, Thing, int]] = []
        for row, number in zip(kept.tolist(), near[kept].tolist(), strict=True):
            partner = ObjectOrdinal(number)
            other = self._index.thing(partner)
            both = thing.met.get(partner, 0)
            if both * _SHARE_OF_PICTURES > min(thing.count, other.count):
                continue
            if self._groups is not None and self._groups.conflicts(thing.groups, other.groups):
                continue
            candidates.append((row, partner, other, both))
        if not candidates:
            return None
        best: tuple[float, ObjectOrdinal, MergeEvidence] | None = None
        looks = self._looks(thing, [other for _, _, other, _ in candidates])
        for (row, partner, other, both), look in zip(candidates, looks, strict=True):
            value = look + float(geometry[row])
            if value > 0.0 and (best is None or value > best[0]):
                evidence = MergeEvidence(
                    round(look * 1000.0),
                    round(float(geometry[row]) * 1000.0),
                    round(math.sqrt(dx[row] * dx[row] + dy[row] * dy[row]) * 1e6),
                    both,
                    thing.count + other.count - both,
                )
                best = value, partner, evidence
        return None if best is None else best[1:]

    def look(self, one: Thing, other: Thing) -> float:
        """How much the looks of two things speak for one, as the logarithm of a ratio of two
        likelihoods: the mean over pairs of exemplars, and the labels."""
        return self._looks(one, [other])[0]

    def _looks(self, one: Thing, others: list[Thing]) -> list[float]:
        """`look` for each of several others: their exemplars are columns of one matrix."""
        counts = [other.exemplars for other in others]
        agree = [o.class_name in one.classes or one.class_name in o.classes for o in others]
        a = one.marks[: one.exemplars]
        b = np.concatenate([other.marks[: other.exemplars] for other in others])
        looks = np.concatenate([other.looks[: other.exemplars] for other in others])
        dots = (one.looks[: one.exemplars] @ looks.T).astype(np.float64)
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
        values: list[float] = []
        first = 0
        for other, count in zip(others, counts, strict=True):
            total = int(sums[first : first + count].sum())
            mean = total / (one.exemplars * count * _UNIT)
            values.append(mean + self._by_labels(one, other))
            first += count
        return values

    def _by_labels(self, one: Thing, other: Thing) -> float:
        """The part of the labels in `look`."""
        labels = 0.0
        for label, count in other.classes.items():
            labels += count * self._labels.ratio(one, label)
        return LABEL_WEIGHT * labels / other.count
