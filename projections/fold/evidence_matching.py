"""Matching: assign an Object to each observation of a picture (rules 1 to 3 of `evidence_objects`).

Where several observations want the same Object, `assign` makes the choice with the largest sum of
evidence. Observations that want no Object in common do not depend on each other. Of those that do,
up to `_MOST` are assigned by the Hungarian method, each considered for as many Objects as there are
observations, its best. More than that, which no camera sees, are assigned greedily, the largest
evidence first, so that a picture's cost is bounded.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

from eventsrc.envelope.model import DetId

from .agreement import Agreement, Slopes
from .deltas import ObjectOrdinal, Pose, RunOrdinal
from .exact import exp
from .looks import LookRatios, Looks, LookScale
from .pair_groups import PairGroups
from .sights import Sight, Sighting
from .thing_index import ThingIndex
from .things import LABEL_WEIGHT, FusedThing, LabelCounts

Match: TypeAlias = tuple[float, ObjectOrdinal, float | None]
"""The evidence for an Object, its ordinal, and the cosine of the best pair of looks, None where one
of the two has no look."""
_MOST = 32


def _value(match: Match) -> float:
    return match[0]


def assign(wanted: Sequence[Sequence[Match]]) -> list[Match | None]:
    """The match assigned to each observation, among its ``wanted`` ones, all with evidence above 0;
    None for none. Each Object is assigned at most once. Ties are broken deterministically."""
    taken = [max(matches, key=_value) if matches else None for matches in wanted]
    ordinals = [match[1] for match in taken if match is not None]
    if len(set(ordinals)) == len(ordinals):
        return taken
    for together in _together(wanted):
        if len(together) > 1:
            own = [wanted[row] for row in together]
            chosen = _largest_sum(own) if len(own) <= _MOST else _best_first(own)
            for row, match in zip(together, chosen, strict=True):
                taken[row] = match
    return taken


def _together(wanted: Sequence[Sequence[Match]]) -> list[list[int]]:
    """The observations that want an Object in common, directly or through others, ascending."""
    leader = list(range(len(wanted)))

    def leader_of(row: int) -> int:
        while leader[row] != row:
            row = leader[row]
        return row

    first: dict[ObjectOrdinal, int] = {}
    for row, matches in enumerate(wanted):
        for _, ordinal, _ in matches:
            one, other = leader_of(first.setdefault(ordinal, row)), leader_of(row)
            leader[max(one, other)] = min(one, other)
    together: dict[int, list[int]] = {}
    for row in range(len(wanted)):
        together.setdefault(leader_of(row), []).append(row)
    return list(together.values())


def _best_first(wanted: Sequence[Iterable[Match]]) -> list[Match | None]:
    """Matches taken in the order of their evidence."""
    taken: list[Match | None] = [None] * len(wanted)
    used: set[ObjectOrdinal] = set()
    pairs = [(match, row) for row, matches in enumerate(wanted) for match in matches]
    for match, row in sorted(pairs, key=lambda pair: -pair[0][0]):
        if taken[row] is None and match[1] not in used:
            taken[row] = match
            used.add(match[1])
    return taken


def _largest_sum(wanted: Sequence[Sequence[Match]]) -> list[Match | None]:
    """The Hungarian method with potentials, one observation after the other. Where an observation
    does not want an Object, and in columns without one, the gain is 0: it takes none."""
    size = len(wanted)
    columns: dict[ObjectOrdinal, int] = {}
    rows: list[dict[int, Match]] = []
    for matches in wanted:
        best = sorted(matches, key=_value, reverse=True)[:size]
        rows.append({columns.setdefault(match[1], len(columns) + 1): match for match in best})
    width = max(len(columns), size) + 1
    gains = [[0.0] * width for _ in range(size)]
    for of_one, own in zip(gains, rows, strict=True):
        for column, match in own.items():
            of_one[column] = match[0]
    of_row, of_column = [0.0] * size, [0.0] * width  # potentials
    holder = [-1] * width  # column → its observation
    for new in range(size):
        holder[0], column = new, 0
        slack, way = [float("inf")] * width, [0] * width
        left = set(range(1, width))
        path = [0]
        while holder[column] >= 0:
            row = holder[column]
            gain, base = gains[row], of_row[row]
            least, nearest = float("inf"), 0
            for other in sorted(left):
                rest = base + of_column[other] - gain[other]
                if rest < slack[other]:
                    slack[other], way[other] = rest, column
                if slack[other] < least:
                    least, nearest = slack[other], other
            for other in path:
                of_row[holder[other]] -= least
                of_column[other] += least
            for other in left:
                slack[other] -= least
            column = nearest
            left.remove(column)
            path.append(column)
        while column:
            before = way[column]
            holder[column] = holder[before]
            column = before
    taken: list[Match | None] = [None] * size
    for column in range(1, width):
        if holder[column] >= 0:
            taken[holder[column]] = rows[holder[column]].get(column)
    return taken


_WITHOUT_LOOKS = 0.0, 1.0
"""The ratio that stands for that of the looks where there are not two, by whether the labels agree:
this thing's being seen again is that much likelier than another one of its class, unseen so far."""
_SEEN_ONCE = 1.5
"""What such a pair loses with a thing seen once: many of these are phantoms and wrong labels."""
_LEAST_EXPONENT = -50.0
Choice: TypeAlias = tuple[ObjectOrdinal | None, float | None, float]
"""An Object, None for a new one; the cosine of the best pair of looks, as in `Match`; the
probability that it is that Object and no other."""
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
                if other[1] == ordinal:
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
        """The matches of each observation, by ordinal of the Object."""
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
            if not (inverses[column] and thing.marks):
                value += _WITHOUT_LOOKS[agree]
                if thing.count == 1:
                    value -= _SEEN_ONCE
                matches[column].append((value, ordinal, None))
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
        thing: FusedThing,
        sighting: Sighting,
        object_of: Mapping[int, ObjectOrdinal],
    ) -> bool:
        """Whether a command keeps the observation apart from the thing."""
        group = groups.group_of.get(sighting.det_id)
        if group is None:
            return False
        own = object_of.get(group)
        inside = {group} if own is None else self._index.thing(own).groups
        return thing.groups is not inside and groups.are_apart(inside, thing.groups)


class _Second:
    """The second choice of an observation that has to give up its Object: the best Object assigned
    to no observation, one that is freed, or none."""

    def __init__(
        self, own: list[Match], taken: Match | None, holders: Mapping[ObjectOrdinal, int]
    ) -> None:
        self._value = 0.0 if taken is None else taken[0]
        self._values = {ordinal: value for value, ordinal, _ in own}
        self._best = max([value for value, ordinal, _ in own if ordinal not in holders] + [0.0])

    def lost(self, freed: ObjectOrdinal) -> float:
        """The evidence that is lost if ``freed`` is free."""
        return self._value - max(self._best, self._values.get(freed, 0.0))
