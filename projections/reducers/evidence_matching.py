"""Which Object each observation of a picture is of: rules 1 to 3 of `evidence_objects`."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope import DetId
from projections.deltas import ObjectOrdinal, Pose, RunOrdinal
from projections.exact_functions import exp
from projections.pair_groups import PairGroups

from .agreement import Agreement, Slopes
from .label_counts import LABEL_WEIGHT, LabelCounts
from .looks import Floats, LookRatios, Looks, LookScale
from .sights import Sight, Sighting
from .thing_index import ThingIndex
from .things import INVERSE, RUN, SIDE_COS, SIDE_SIN, Thing

_BEST = 4
_MISSING = 0.125
_LEAST_AGREEMENT = -5.0


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
        inverses: Floats,
        sights: list[Sight],
        sightings: Sequence[Sighting],
        object_of: Mapping[int, ObjectOrdinal],
    ) -> list[tuple[ObjectOrdinal | None, float, float]]:
        """The Object of each observation, None for a new one, and the cosine of the best pair."""
        chosen: list[tuple[ObjectOrdinal | None, float, float]] = [(None, 1.0, 1.0)] * len(sights)
        near = self._index.near(pose.x_um / 1e6, pose.y_um / 1e6)
        if not len(near):
            return chosen
        rows, columns, values = self._agreement.pairs(
            self._index.estimates.take(near, axis=1),
            sights,
            self._slopes.mean_square,
            _LEAST_AGREEMENT,
        )
        if not len(rows):
            return chosen
        things = [self._index.thing(ordinal) for ordinal in near[rows].tolist()]
        names = [labels[column] for column in columns.tolist()]
        by_label, agree = self._labels.ratios(things, names)
        values += LABEL_WEIGHT * by_label
        kept = (values + self._look_ratios.at_best(agree) > 0.0).nonzero()[0]
        if not len(kept):
            return chosen
        columns, values = columns[kept], values[kept]
        pairs = list(zip(near[rows[kept]].tolist(), columns.tolist(), strict=True))
        things = [things[place] for place in kept.tolist()]
        by_look, cosines = self._look_values(
            things, columns, run, agree[kept, np.newaxis], looks, inverses, sights
        )
        values += by_look
        if self._groups is not None:
            self._forbid(self._groups, values, pairs, things, sightings, object_of)
        flat, flat_cosines = values.tolist(), cosines.tolist()
        places_of: list[list[int]] = [[] for _ in sights]
        for place, (_, column) in enumerate(pairs):
            places_of[column].append(place)
        used: set[ObjectOrdinal] = set()
        for place in (-values).argsort(kind="stable").tolist():
            if flat[place] <= 0.0:
                break
            ordinal, column = pairs[place]
            if ordinal not in used and chosen[column][0] is None:
                rivals = 1.0
                for other in places_of[column]:
                    if other != place and pairs[other][0] not in used:
                        rivals += exp(min(flat[other], 50.0))
                mine = exp(min(flat[place], 50.0))
                chosen[column] = ordinal, flat_cosines[place], mine / (mine + rivals)
                used.add(ordinal)
        return chosen

    def _look_values(
        self,
        things: list[Thing],
        columns: NDArray[np.intp],
        run: RunOrdinal,
        agree: NDArray[np.bool_],
        looks: Looks,
        inverses: Floats,
        sights: list[Sight],
    ) -> tuple[Floats, Floats]:
        """The ratio of looks of each pair of an Object and an observation, and the best cosine."""
        counts = np.array([thing.exemplars for thing in things])
        most = max([len(thing.looks) for thing in things])
        dots = np.zeros((len(things), most))
        look_of = list(looks)
        for row, (thing, column) in enumerate(zip(things, columns.tolist(), strict=True)):
            room = len(thing.looks)  # rows of zeros after the exemplars
            dots[row, :room] = thing.looks.dot(look_of[column])
        marks = np.array([thing.marks for thing in things])[:, :most]
        cosines = dots * marks[:, :, INVERSE] * inverses[columns, np.newaxis]
        is_missing = np.arange(most) >= counts[:, np.newaxis]
        different = self._scale.different()
        likeness = (cosines - different) * (1.0 / (1.0 - different))
        toward = np.array([(sight.side_cos, sight.side_sin) for sight in sights])[columns]
        sides = marks[:, :, SIDE_COS] * toward[:, :1] + marks[:, :, SIDE_SIN] * toward[:, 1:]
        ratios = self._look_ratios.ratios(likeness, sides, marks[:, :, RUN] != run, agree)
        ratios[is_missing] = -np.inf
        ratios.sort(axis=1)
        best = ratios[:, : -_BEST - 1 : -1]  # descending
        best = np.where(best == -np.inf, 0.0, best)
        total = best[:, 0].copy()
        for rank in range(1, best.shape[1]):
            total += best[:, rank]
        counts = np.minimum(counts, _BEST)
        cosines[is_missing] = -1.0
        return total / counts - _MISSING * (_BEST - counts), cosines.max(axis=1)

    def _forbid(
        self,
        groups: PairGroups[DetId],
        values: Floats,
        pairs: list[tuple[ObjectOrdinal, int]],
        things: list[Thing],
        sightings: Sequence[Sighting],
        object_of: Mapping[int, ObjectOrdinal],
    ) -> None:
        """Leave out what commands keep apart."""
        for place, ((_, column), thing) in enumerate(zip(pairs, things, strict=True)):
            group = groups.group_of.get(sightings[column].det_id)
            if group is None:
                continue
            own = object_of.get(group)
            inside = {group} if own is None else self._index.thing(own).groups
            if thing.groups is not inside and groups.conflicts(inside, thing.groups):
                values[place] = -np.inf
