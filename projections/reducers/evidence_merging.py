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
from .label_counts import LabelCounts
from .looks import LookRatios, LookScale
from .thing_index import ThingIndex
from .things import INVERSE, RUN, SIDE_COS, SIDE_SIN, Thing

_LOG_AREA = log(9.0) - 1.8378770664093453
"""log(9 m² / 2π)."""
_WORST_CHI2 = 40.0
_LEAST_GEOMETRY = -3.0
_SHARE_OF_PICTURES = 10
_MOST_PER_PAIR = 6.0
_LABEL_WEIGHT = 0.5
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
        best: tuple[float, ObjectOrdinal, MergeEvidence] | None = None
        kept = (geometry > _LEAST_GEOMETRY).nonzero()[0]
        for row, number in zip(kept.tolist(), near[kept].tolist(), strict=True):
            partner = ObjectOrdinal(number)
            other = self._index.thing(partner)
            both = thing.met.get(partner, 0)
            if both * _SHARE_OF_PICTURES > min(thing.count, other.count):
                continue
            if self._groups is not None and self._groups.conflicts(thing.groups, other.groups):
                continue
            look = self.look(thing, other)
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
        a, b = one.marks[: one.exemplars], other.marks[: other.exemplars]
        dots = (one.looks[: one.exemplars] @ other.looks[: other.exemplars].T).astype(np.float64)
        cosines = dots * a[:, INVERSE, np.newaxis] * b[:, INVERSE]
        different = self._scale.different()
        ratios = self._look_ratios.ratios(
            (cosines - different) * (1.0 / (1.0 - different)),
            a[:, SIDE_COS, np.newaxis] * b[:, SIDE_COS]
            + a[:, SIDE_SIN, np.newaxis] * b[:, SIDE_SIN],
            a[:, RUN, np.newaxis] != b[:, RUN],
            np.array(one.class_name in other.classes or other.class_name in one.classes),
        )
        ratios = np.maximum(np.minimum(ratios, _MOST_PER_PAIR), -_MOST_PER_PAIR)
        total = int(np.rint(ratios * _UNIT).astype(np.int64).sum())  # exact: integers
        mean = total / (one.exemplars * other.exemplars * _UNIT)
        return mean + self._by_labels(one, other)

    def _by_labels(self, one: Thing, other: Thing) -> float:
        """The part of the labels in `look`."""
        labels = 0.0
        for label, count in other.classes.items():
            labels += count * self._labels.ratio(one, label)
        return _LABEL_WEIGHT * labels / other.count
