"""Observations fused into Objects with an estimated position: the rule of `fusion = "evidence"`.

The rules, for the observations of one picture:

1.  Each becomes a sight (`sights`) and a look (`looks`). Candidates are the Objects whose estimate
    is within reach of the robot: the usual range times exp(1.5 spreads), and 1.5 m.
2.  The evidence that an observation is of a candidate is a log-likelihood ratio: of its sight and
    the estimate (`agreement`), of its look and the exemplars (the mean of the best four; each that
    is missing costs an eighth), and half of that of its label and the labels seen so far
    (`LabelCounts`). Below −5 the sight alone rules a candidate out. Where there is no look on one
    side, since a detection came without an embedding, constants stand for the looks' part.
3.  Each observation goes to one Object, and each Object gets one observation of a picture: two
    things in one picture are not one. Of all such choices that with the largest sum of evidence is
    taken, a pair's being above 0 (`assign`). What is left founds Objects. Where other Objects,
    or a new one, or two observations exchanged were nearly as probable, the sight weighs only its
    probability in the estimate, and below 0.85 the look is no exemplar.
4.  The Object's estimate is solved again from its spots (`spots`), its class is that of most of its
    observations.
5.  Two Objects are merged when better views show that they are one (`evidence_merging`).

Under ``same-object`` and ``different-objects`` the rules of `objects` hold besides:
Objects that are kept apart are no candidates for each other's observations, those that are one are
merged at once, also within one picture.

Everything is bit-exact: integers, and float64 by operations that IEEE 754 defines to the last bit,
in one order; transcendental functions are those of `projections.fold.exact`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

from eventsrc.envelope.model import DetId, Offset

from . import State, part, prefixed
from . import deltas as d
from .agreement import Agreement, Slopes
from .evidence import EvidenceConstants
from .evidence_matching import Matching
from .evidence_merging import Merging, turned_looks
from .exact import MAX_IN_A_SUM, Q40
from .looks import LookRatios, LookScale, looks_of
from .objects import object_id
from .pair_groups import PairGroups
from .settings import CameraConstants
from .sights import PoseError, Sighting, Sights
from .spots import Spots
from .thing_index import ThingIndex
from .things import FusedThing, LabelCounts

ObjectDelta: TypeAlias = (
    d.ObjectFound
    | d.ObjectSeen
    | d.ObjectsMerged
    | d.ObjectRelocated
    | d.ObjectClassified
    | d.ObjectEstimated
)
_SURE = 0.85


class MovedObject(NamedTuple):
    """The Object ``old`` stands where ``new`` was found, by ``observation``; ``look`` is the
    log-likelihood ratio of their looks."""

    old: d.ObjectOrdinal
    new: d.ObjectOrdinal
    observation: d.ObservationOrdinal
    look: float


class EvidenceObjects:
    """The reducer."""

    def __init__(
        self, constants: EvidenceConstants, groups: PairGroups[DetId] | None = None
    ) -> None:
        self._groups = groups
        self._sights = Sights(constants)
        self._look_ratios = LookRatios(constants)
        self._scale = LookScale(constants.different)
        self._slopes = Slopes()
        self._labels = LabelCounts()
        self._index = ThingIndex(constants)
        self._object_of: dict[int, d.ObjectOrdinal] = {}  # group → its Object
        self._matching = Matching(
            Agreement(constants.range_m, constants.range_spread, self._index.reach_m),
            self._index,
            self._look_ratios,
            self._scale,
            self._slopes,
            self._labels,
            groups,
        )
        self._merging = Merging(self._index, self._look_ratios, self._scale, self._labels, groups)

    def fold(
        self,
        offset: Offset,
        run: d.RunOrdinal,
        timestamp: float,
        pose: d.Pose,
        camera: CameraConstants,
        sightings: Sequence[Sighting],
        error: PoseError | None = None,
    ) -> list[ObjectDelta]:
        """Fuse the observations of one picture; ``error`` is that of its pose, if it is known."""
        if not sightings:
            return []
        labels = [sighting.class_name for sighting in sightings]
        looks, inverses = looks_of([sighting.vector for sighting in sightings])
        sights = self._sights.of(pose, camera, sightings, error)
        self._scale.learn(labels, looks, inverses)
        self._slopes.learn(sights)
        self._labels.learn(labels)
        chosen = self._matching.choose(
            run, pose, labels, looks, inverses, sights, sightings, self._object_of
        )
        deltas: list[ObjectDelta] = []
        seen: list[d.ObjectOrdinal] = []
        named: dict[d.ObjectOrdinal, str] = {}  # the classes before
        to_unite: list[tuple[d.ObjectOrdinal, d.ObjectOrdinal]] = []
        index, groups, group, own = self._index, self._groups, None, None
        for k, sighting in enumerate(sightings):
            wanted, cosine, share = chosen[k]
            if groups is not None:
                group = groups.group_of.get(sighting.det_id)
                own = None if group is None else self._object_of.get(group)
                if group is not None:
                    wanted = self._allowed(group, own, wanted)
            if wanted is None:
                ordinal, found = self._found(offset, sighting, pose, timestamp)
                named[ordinal] = sighting.class_name
                deltas.append(found)
                thing = index.thing(ordinal)
            else:
                ordinal, thing = wanted, index.thing(wanted)
                named.setdefault(ordinal, thing.class_name)
                _count(thing, ordinal, sighting.class_name, pose, timestamp)
            sight = sights[k]
            spot = thing.spots.add(sight, share)
            if share >= _SURE and inverses[k]:
                thing.keep(looks[k], inverses[k], sight.side_cos, sight.side_sin, run)
            index.solve(ordinal, thing, spot)
            seen.append(ordinal)
            deltas.append(
                d.ObjectSeen(
                    offset,
                    ordinal,
                    sighting.observation,
                    _similarity(wanted, cosine) if inverses[k] else None,
                    thing.count,
                    thing.sum_x_um,
                    thing.sum_y_um,
                    thing.first_seen,
                    thing.last_seen,
                )
            )
            if group is not None:
                thing.groups.add(group)
                if own is None:
                    self._object_of[group] = ordinal
                elif own != ordinal:
                    to_unite.append((own, ordinal))
        index.count_meetings(seen)
        changed = set(seen)
        for pair in to_unite:
            one, other = map(index.survivor_of, pair)
            if one != other:
                deltas.append(self._unite(offset, one, other, changed, named, None))
        for ordinal in sorted(changed):
            if ordinal not in changed:
                continue
            thing = index.thing(ordinal)
            if thing.count < thing.checked:
                continue
            partner = self._merging.partner_of(ordinal)
            if partner is not None:
                other, why = partner
                deltas.append(self._unite(offset, ordinal, other, changed, named, why))
        ascending = sorted(changed)
        for ordinal in ascending:
            class_name = index.thing(ordinal).class_name
            if class_name != named[ordinal]:
                deltas.append(d.ObjectClassified(offset, ordinal, class_name))
        deltas += [index.estimated(offset, ordinal) for ordinal in ascending]
        return deltas

    def class_of(self, ordinal: d.ObjectOrdinal) -> str:
        """The class of most of an Object's observations."""
        return self._index.thing(ordinal).class_name

    def observations_of(self, ordinal: d.ObjectOrdinal) -> int:
        """How many observations an Object has."""
        return self._index.thing(ordinal).count

    def compare(
        self, one: d.ObjectOrdinal, others: Sequence[d.ObjectOrdinal]
    ) -> list[float | None]:
        """The log-likelihood ratio of the looks of an Object and of each of several others,
        whatever their headings (`turned_looks`); None where a command keeps them apart, or one of
        them has no look."""
        thing, things = self._index.thing(one), [self._index.thing(other) for other in others]
        groups = self._groups
        may_be = [
            bool(thing.marks and other.marks)
            and not (groups and groups.are_apart(thing.groups, other.groups))
            for other in things
        ]
        alike = [other for other, may in zip(things, may_be, strict=True) if may]
        looks = iter(turned_looks(thing, alike, self._look_ratios, self._scale))
        return [next(looks) if may else None for may in may_be]

    def relocate(self, offset: Offset, moved: MovedObject) -> list[ObjectDelta]:
        """Merge an Object with the one found at its new position, and estimate it from the later
        observations only."""
        thing, later = self._index.thing(moved.old), self._index.thing(moved.new)
        before, after = thing.where()[:2], later.where()[:2]
        dx, dy = after[0] - before[0], after[1] - before[1]
        evidence = d.MergeEvidence(
            round(moved.look * 1000.0),
            0,
            round(math.sqrt(dx * dx + dy * dy) * 1e6),
            thing.met.get(moved.new, 0),
            thing.count + later.count,
        )
        thing.spots, thing.estimate = Spots(), later.estimate
        class_name = thing.class_name
        merged = self._unite(offset, moved.old, moved.new, set(), {}, evidence)
        places = [round(number * 1e6) for number in (*before, *after)]
        deltas: list[ObjectDelta] = [
            merged,
            d.ObjectRelocated(offset, moved.old, moved.observation, *places),
        ]
        if thing.class_name != class_name:
            deltas.append(d.ObjectClassified(offset, moved.old, thing.class_name))
        return [*deltas, self._index.estimated(offset, moved.old)]

    def dump(self) -> State:
        """The whole state, to be kept."""
        return (
            {"object_of": sorted(map(list, self._object_of.items()))}
            | prefixed("scale", self._scale.dump())
            | prefixed("slopes", self._slopes.dump())
            | prefixed("labels", self._labels.dump())
            | prefixed("things", self._index.dump())
        )

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._object_of = {group: d.ObjectOrdinal(ordinal) for group, ordinal in state["object_of"]}
        self._scale.load(part("scale", state))
        self._slopes.load(part("slopes", state))
        self._labels.load(part("labels", state))
        self._index.load(part("things", state))

    def _allowed(
        self, group: int, own: d.ObjectOrdinal | None, wanted: d.ObjectOrdinal | None
    ) -> d.ObjectOrdinal | None:
        """The wanted Object, unless a command keeps it apart; then the group's own one, if any."""
        if self._groups is None or wanted is None:
            return own
        inside = {group} if own is None else self._index.thing(own).groups
        others = self._index.thing(wanted).groups
        return own if wanted != own and self._groups.are_apart(inside, others) else wanted

    def _found(
        self, offset: Offset, sighting: Sighting, pose: d.Pose, timestamp: float
    ) -> tuple[d.ObjectOrdinal, d.ObjectFound]:
        """Found an Object."""
        label, times = sighting.class_name, (timestamp, timestamp)
        thing = FusedThing(1, pose.x_um, pose.y_um, *times, label, {label: 1}, Spots())
        ordinal = self._index.add(thing)
        identity = object_id(sighting.det_id)
        return ordinal, d.ObjectFound(offset, ordinal, identity, label, sighting.observation)

    def _unite(
        self,
        offset: Offset,
        one: d.ObjectOrdinal,
        other: d.ObjectOrdinal,
        changed: set[d.ObjectOrdinal],
        named: dict[d.ObjectOrdinal, str],
        evidence: d.MergeEvidence | None,
    ) -> d.ObjectsMerged:
        """Merge two Objects; the one founded first survives."""
        survivor, absorbed = min(one, other), max(one, other)
        moved = self._index.thing(absorbed).groups
        self._object_of |= dict.fromkeys(moved, survivor)
        named.setdefault(survivor, self._index.thing(survivor).class_name)
        self._index.unite(survivor, absorbed)
        changed.discard(absorbed)
        changed.add(survivor)
        thing = self._index.thing(survivor)
        return d.ObjectsMerged(
            offset,
            survivor,
            absorbed,
            thing.count,
            thing.sum_x_um,
            thing.sum_y_um,
            thing.first_seen,
            thing.last_seen,
            evidence,
        )


def _similarity(wanted: d.ObjectOrdinal | None, cosine: float | None) -> int | None:
    """The similarity of an observation that has a look, as in `ObjectSeen`."""
    if wanted is None:
        return Q40
    return None if cosine is None else round(cosine * Q40)


def _count(
    thing: FusedThing, ordinal: d.ObjectOrdinal, label: str, pose: d.Pose, timestamp: float
) -> None:
    """Add an observation to an Object's sums."""
    if thing.count >= MAX_IN_A_SUM:
        raise OverflowError(
            f"object {ordinal} of class {thing.class_name!r} has {MAX_IN_A_SUM} observations, "
            "the bound of its exact arithmetic"
        )
    thing.count += 1
    thing.sum_x_um += pose.x_um
    thing.sum_y_um += pose.y_um
    if timestamp > thing.last_seen:
        thing.last_seen = timestamp
    elif timestamp < thing.first_seen:
        thing.first_seen = timestamp
    thing.count_label(label)
