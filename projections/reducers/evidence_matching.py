"""Which Object each observation of a picture is of: rules 1 to 3 of `evidence_objects`."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

from eventsrc.envelope import DetId
from projections.deltas import ObjectOrdinal, Pose, RunOrdinal
from projections.exact_functions import exp
from projections.pair_groups import PairGroups

from .agreement import Agreement, Slopes
from .assignment import Match, assign
from .label_counts import LABEL_WEIGHT, LabelCounts
from .looks import LookRatios, Looks, LookScale
from .sights import Sight, Sighting
from .thing_index import ThingIndex
from .things import Thing

_LEAST_EXPONENT = -50.0
Choice: TypeAlias = tuple[ObjectOrdinal | None, float, float]
"""An Object, None for a new one; the cosine of the best pair of looks; the probability that it is
that Object and no other."""
_NEW: Choice = (None, 1.0, 1.0)


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
        matches = self._matches(run, pose, labels, looks, inverses, sights, sightings, object_of)
        taken = assign([[match for match in own if match[0] > 0.0] for own in matches])
        holders = {match[1]: column for column, match in enumerate(taken) if match is not None}
        chosen: list[Choice] = []
        seconds: dict[int, _Second] = {}
        for own, match in zip(matches, taken, strict=True):
            if match is None:
                chosen.append(_NEW)
                continue
            value, ordinal, cosine = match
            rivals = exp(max(-value, _LEAST_EXPONENT))
            for other in own:
                if other is match:
                    continue
                more = other[0] - value
                holder = holders.get(other[1])
                if holder is not None:
                    if holder not in seconds:
                        seconds[holder] = _Second(matches[holder], taken[holder], holders)
                    more -= seconds[holder].lost(ordinal)
                rivals += exp(max(min(more, 0.0), _LEAST_EXPONENT))
            chosen.append((ordinal, cosine, 1.0 / (1.0 + rivals)))
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
    ) -> list[list[Match]]:
        """What each observation may be of, by ordinal."""
        matches: list[list[Match]] = [[] for _ in sights]
        index = self._index
        listed = index.listed(pose.x_um / 1e6, pose.y_um / 1e6)
        if not len(listed):
            return matches
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
            matches[column].append((value + ratio, ordinal, cosine))
        return matches

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


class _Second:
    """What is left to an observation that has to leave the Object it takes: the best of those that
    no observation takes, one that is freed, or none."""

    def __init__(
        self, own: list[Match], taken: Match | None, holders: Mapping[ObjectOrdinal, int]
    ) -> None:
        self._value = 0.0 if taken is None else taken[0]
        self._values = {ordinal: value for value, ordinal, _ in own}
        self._best = max([value for value, ordinal, _ in own if ordinal not in holders] + [0.0])

    def lost(self, freed: ObjectOrdinal) -> float:
        """The evidence that is lost if ``freed`` is free."""
        return self._value - max(self._best, self._values.get(freed, 0.0))
