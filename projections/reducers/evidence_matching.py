"""Which Object each observation of a picture is of: rules 1 to 3 of `evidence_objects`."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

from eventsrc.envelope import DetId
from projections.deltas import ObjectOrdinal, Pose, RunOrdinal
from projections.exact_functions import exp
from projections.pair_groups import PairGroups

from .agreement import Agreement, Slopes
from .label_counts import LABEL_WEIGHT, LabelCounts
from .looks import LookRatios, Looks, LookScale
from .sights import Sight, Sighting
from .thing_index import ThingIndex
from .things import Thing

_MOST_EXPONENT = 50.0
Choice: TypeAlias = tuple[ObjectOrdinal | None, float, float]
"""An Object, None for a new one; the cosine of the best pair of looks; the probability that it is
that Object and no other."""
_NEW: Choice = (None, 1.0, 1.0)


_Match: TypeAlias = tuple[float, ObjectOrdinal, float]
"""How much speaks for an Object, which one, and the cosine of the best pair of looks."""


class Matching:
    """Chooses among the Objects of an index."""

    def __init__(
        self,
        agreement: Agreement,
        index: ThingIndex,
        look_ratios: LookRatios,
        scale: LookScale,
        slopes: Slopes,
        labels: LabelCounts,
        groups: PairGroups[DetId] | None,
    ) -> None:
        self._agreement = agreement
        self._index = index
        self._look_ratios = look_ratios
        self._scale = scale
        self._slopes = slopes
        self._labels = labels
        self._groups = groups

    def choose(
        self,
        run: RunOrdinal,
        pose: Pose,
        labels: list[str],
        looks: Looks,
        inverses: list[float],
        sights: list[Sight],
        sightings: Sequence[Sighting],
        object_of: Mapping[int, ObjectOrdinal],
    ) -> list[Choice]:
        """The choice of each observation."""
        chosen: list[Choice] = [_NEW] * len(sights)
        matches, order = self._matches(
            run, pose, labels, looks, inverses, sights, sightings, object_of
        )
        best_first = [(match, column) for match, column in order if match[0] > 0.0]
        best_first.sort(key=_value, reverse=True)  # of equal ones the first
        used: set[ObjectOrdinal] = set()
        for match, column in best_first:
            value, ordinal, cosine = match
            if ordinal in used or chosen[column][0] is not None:
                continue
            rivals = 1.0
            for other in matches[column]:
                if other is not match and other[1] not in used:
                    rivals += exp(min(other[0], _MOST_EXPONENT))
            mine = exp(min(value, _MOST_EXPONENT))
            chosen[column] = ordinal, cosine, mine / (mine + rivals)
            used.add(ordinal)
        return chosen

    def _matches(
        self,
        run: RunOrdinal,
        pose: Pose,
        labels: list[str],
        looks: Looks,
        inverses: list[float],
        sights: list[Sight],
        sightings: Sequence[Sighting],
        object_of: Mapping[int, ObjectOrdinal],
    ) -> tuple[list[list[_Match]], list[tuple[_Match, int]]]:
        """What each observation may be of, and all of it with the observation, by ordinal."""
        matches: list[list[_Match]] = [[] for _ in sights]
        order: list[tuple[_Match, int]] = []
        index = self._index
        listed = index.listed(pose.x_um / 1e6, pose.y_um / 1e6)
        if not len(listed):
            return matches, order
        estimates = index.estimates.take(listed, axis=0)
        pairs = self._agreement.pairs(estimates, sights, self._slopes.mean_square)
        ordinals: list[ObjectOrdinal] = listed.take(pairs.rows).tolist()
        usual_of = [self._labels.usual(label) for label in labels]
        different, ratio_of_looks = self._scale.different(), self._look_ratios.of_exemplars
        best_agreeing, best = self._look_ratios.at_best(True), self._look_ratios.at_best(False)
        for ordinal, column, value in zip(ordinals, pairs.columns, pairs.ratios, strict=True):
            thing, sight = index.thing(ordinal), sights[column]
            label = labels[column]
            agree = label in thing.classes
            value += LABEL_WEIGHT * self._labels.ratio(thing, label, usual_of[column])
            if value + (best_agreeing if agree else best) <= 0.0:
                continue
            if self._agreement.is_ruled_out(thing.where(), sight):
                continue
            if self._groups is not None and self._is_apart(
                self._groups, thing, sightings[column], object_of
            ):
                continue
            ratio, cosine = ratio_of_looks(
                thing.looks.dot(looks[column]).tolist(),
                thing.marks,
                inverses[column],
                sight.side_cos,
                sight.side_sin,
                run,
                agree,
                different,
            )
            match = value + ratio, ordinal, cosine
            matches[column].append(match)
            order.append((match, column))
        return matches, order

    def _is_apart(
        self,
        groups: PairGroups[DetId],
        thing: Thing,
        sighting: Sighting,
        object_of: Mapping[int, ObjectOrdinal],
    ) -> bool:
        """Whether a command keeps the observation apart from the thing."""
        group = groups.group_of.get(sighting.det_id)
        if group is None:
            return False
        own = object_of.get(group)
        inside = {group} if own is None else self._index.thing(own).groups
        return thing.groups is not inside and bool(groups.conflicts(inside, thing.groups))


def _value(item: tuple[_Match, int]) -> float:
    return item[0][0]
