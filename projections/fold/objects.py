"""Repeated observations fused into Objects: the rule of `fusion = "page"`.

The rules, for an observation of class C made from the pose (x, y):

1.  Candidates are Objects of class C whose mean position is within ``fusion_radius_m`` of (x, y),
    inclusive, and whose mean embedding has at least ``fusion_similarity`` cosine with the
    observation's.
2.  The highest cosine wins, compared as multiples of 2⁻⁴⁰; ties go to the Object founded first.
3.  The winner's position and embedding become the means over all its observations; ``first_seen``
    and ``last_seen`` span their timestamps. Without a candidate a new Object is founded.

An Object's position is the mean of the *robot's* poses, for lack of depth.

The mean embedding is never rounded to a unit vector: the sum S of the unit vectors has the mean's
direction, so the cosine with u is S·u / (|S||u|). S, S·u, |S|² and |u|² are exact integers;
|S + u|² = |S|² + 2 S·u + |u|² keeps the norm up to date without touching S again. S·u is at most
count · 2⁴⁰; `projections.fold.exact` says how it is multiplied exactly, and its bound. A sum of
zero, of opposite looks, has no direction; its cosine with anything is 0.

Every Object is listed in the nine grid cells of side ``fusion_radius_m`` around its mean, so one
look-up finds all candidates however large the map is.

Under ``same-object`` and ``different-objects``, and besides:

4.  The commands name detections, by det_id. Those that are the same by command make a *group*. As
    soon as two of a group belong to Objects, these are one: the one founded first survives, with
    the sums over the observations of both. It is found as an Object of all its members' classes.
5.  Objects with detections that are kept apart by command *conflict*; they are never merged. An
    observation that the commands name fuses with the best candidate that conflicts with neither its
    group nor the Object that its group has; without one it joins that Object, however far and
    unlike it is, or founds a new one.

So both are obeyed exactly. An observation that has no embedding of the map's space or no pose is of
no Object, whatever a command says of it.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import DetId, Offset

from . import State
from .deltas import (
    FusibleObservation,
    ObjectFound,
    ObjectOrdinal,
    ObjectSeen,
    ObjectsMerged,
    ObservationOrdinal,
)
from .exact import MAX_IN_A_SUM, MAX_IN_ONE_DOT, Q40, dot_of_sums, long_dot, metres_to_um
from .pair_groups import NO_GROUPS, PairGroups

NO_VECTOR: Final = np.zeros(0)
"""The vector of an observation without an embedding, which only fusion by evidence fuses."""
Bucket = tuple[str, int, int]
"""Class name, column and row of a grid cell."""
Listed: TypeAlias = tuple[tuple[str, ...], int, int]
"""Class names, and the column and row of the grid cell in the middle of those that list it."""


@dataclass(slots=True, eq=False)
class ObjectSums:
    """An Object's sums over its observations: of positions, µm, and of unit vectors, integers in
    float64, shape (dim,). ``column`` and ``row`` are the grid cell of its mean position;
    ``other_classes`` are the classes of members that a command joined to it."""

    class_name: str
    vector_sum: NDArray[np.float64]
    norm2: int
    count: int
    sum_x_um: int
    sum_y_um: int
    first_seen: float
    last_seen: float
    column: int
    row: int
    other_classes: tuple[str, ...] = ()

    @property
    def listed(self) -> Listed:
        """What determines the buckets that list it."""
        return (self.class_name, *self.other_classes), self.column, self.row


def object_id(det_id: DetId) -> str:
    """The id of the Object that the observation ``det_id`` founds."""
    return "obj-" + hashlib.sha256(det_id.encode()).hexdigest()[:16]


class Objects:
    """The reducer."""

    def __init__(self, fusion_radius_m: float, fusion_similarity: float) -> None:
        self._radius_um = max(metres_to_um(fusion_radius_m), 1)
        self._least_q40 = fusion_similarity * Q40
        self.sums: list[ObjectSums] = []  # by ordinal
        self._near: dict[Bucket, list[ObjectOrdinal]] = {}

    def fold(
        self,
        offset: Offset,
        seen: FusibleObservation,
        timestamp: float,
        x_um: int,
        y_um: int,
        candidates: Sequence[ObjectOrdinal] | None = None,
        otherwise: ObjectOrdinal | None = None,
    ) -> list[ObjectFound | ObjectSeen]:
        """Fuse one observation, seen from (x, y).

        ``candidates`` are some of `candidates_at`, all by default; ``otherwise`` is the Object to
        fuse with if none of them qualifies, a new one by default.
        """
        observation, det_id, class_name, vector, norm2 = seen
        radius_um, objects = self._radius_um, self.sums
        column, row = x_um // radius_um, y_um // radius_um
        winner: ObjectOrdinal | None = None
        best_q40, best_dot = -math.inf, 0
        if candidates is None:
            candidates = self._near.get((class_name, column, row), ())
        for candidate in candidates:
            sums = objects[candidate]
            count = sums.count
            dx = sums.sum_x_um - x_um * count
            dy = sums.sum_y_um - y_um * count
            if dx * dx + dy * dy > (radius_um * count) ** 2:
                continue
            if count <= MAX_IN_ONE_DOT:
                dot = int(sums.vector_sum.dot(vector))
            else:
                dot = long_dot(sums.vector_sum, vector)
            # Both conversions, √ and ÷ are correctly rounded.
            q40 = round(dot / math.sqrt(sums.norm2 * norm2 or 1) * Q40)
            if q40 > best_q40 or (q40 == best_q40 and winner is not None and candidate < winner):
                winner, best_q40, best_dot = candidate, q40, dot
        if winner is None or best_q40 < self._least_q40:
            winner = otherwise
            if winner is not None:
                best_dot = long_dot(objects[winner].vector_sum, vector)
                best_q40 = round(best_dot / math.sqrt(objects[winner].norm2 * norm2 or 1) * Q40)
        if winner is None:
            sums = ObjectSums(
                class_name, vector.copy(), norm2, 1, x_um, y_um, timestamp, timestamp, column, row
            )
            return self._add_object(offset, observation, det_id, sums)
        sums = objects[winner]
        if sums.count >= MAX_IN_A_SUM:
            raise OverflowError(
                f"object {winner} of class {class_name!r} has {MAX_IN_A_SUM} observations, "
                "the bound of its exact arithmetic"
            )
        sums.vector_sum += vector
        sums.norm2 += 2 * best_dot + norm2
        self._update(winner, sums, timestamp, x_um, y_um)
        return [_object_seen(offset, winner, observation, int(best_q40), sums)]

    def candidates_at(self, class_name: str, x_um: int, y_um: int) -> Sequence[ObjectOrdinal]:
        """The Objects of a class whose mean position may be within the radius."""
        radius_um = self._radius_um
        return self._near.get((class_name, x_um // radius_um, y_um // radius_um), ())

    def dump(self) -> State:
        """The whole state, to be kept; the sums of vectors are one matrix, a row an Object."""
        objects = self.sums
        return {
            "classes": [o.class_name for o in objects],
            "vectors": np.array([o.vector_sum for o in objects]),
            "norms2": [o.norm2 for o in objects],
            "counts": [o.count for o in objects],
            "sums_x_um": [o.sum_x_um for o in objects],
            "sums_y_um": [o.sum_y_um for o in objects],
            "seen": np.array([(o.first_seen, o.last_seen) for o in objects]).reshape(-1, 2),
            "cells": [(o.column, o.row) for o in objects],
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        for index, (first, last) in enumerate(state["seen"].tolist()):
            sums = ObjectSums(
                state["classes"][index],
                state["vectors"][index].copy(),
                state["norms2"][index],
                state["counts"][index],
                state["sums_x_um"][index],
                state["sums_y_um"][index],
                first,
                last,
                *state["cells"][index],
            )
            self.sums.append(sums)
            self._list(ObjectOrdinal(index), sums)

    def _add_object(
        self, offset: Offset, observation: ObservationOrdinal, det_id: DetId, sums: ObjectSums
    ) -> list[ObjectFound | ObjectSeen]:
        ordinal = ObjectOrdinal(len(self.sums))
        self.sums.append(sums)
        self._list(ordinal, sums)
        found = ObjectFound(offset, ordinal, object_id(det_id), sums.class_name, observation)
        return [found, _object_seen(offset, ordinal, observation, Q40, sums)]

    def _update(
        self, ordinal: ObjectOrdinal, sums: ObjectSums, timestamp: float, x_um: int, y_um: int
    ) -> None:
        sums.count += 1
        sums.sum_x_um += x_um
        sums.sum_y_um += y_um
        if timestamp > sums.last_seen:
            sums.last_seen = timestamp
        elif timestamp < sums.first_seen:
            sums.first_seen = timestamp
        side = self._radius_um * sums.count
        column, row = sums.sum_x_um // side, sums.sum_y_um // side
        if (column, row) != (sums.column, sums.row):
            before = sums.listed
            sums.column, sums.row = column, row
            self._list_again(ordinal, before, sums)

    def _list(self, ordinal: ObjectOrdinal, sums: ObjectSums) -> None:
        """Enter it in the nine cells around its mean position."""
        for bucket in _buckets(*sums.listed):
            self._near.setdefault(bucket, []).append(ordinal)

    def _unlist(self, ordinal: ObjectOrdinal, sums: ObjectSums) -> None:
        for bucket in _buckets(*sums.listed):
            self._near[bucket].remove(ordinal)

    def _list_again(self, ordinal: ObjectOrdinal, before: Listed, sums: ObjectSums) -> None:
        """Remove it where it was listed before and is not now; enter it where it was not."""
        if sums.listed == before:
            return
        old, new = _buckets(*before), _buckets(*sums.listed)
        for bucket in old - new:
            self._near[bucket].remove(ordinal)
        for bucket in new - old:
            self._near.setdefault(bucket, []).append(ordinal)


def _buckets(classes: tuple[str, ...], column: int, row: int) -> set[Bucket]:
    return {
        (class_name, column + dx, row + dy)
        for class_name in classes
        for dx in (-1, 0, 1)
        for dy in (-1, 0, 1)
    }


def _object_seen(
    offset: Offset,
    ordinal: ObjectOrdinal,
    observation: ObservationOrdinal,
    similarity_q40: int,
    sums: ObjectSums,
) -> ObjectSeen:
    return ObjectSeen(
        offset,
        ordinal,
        observation,
        similarity_q40,
        sums.count,
        sums.sum_x_um,
        sums.sum_y_um,
        sums.first_seen,
        sums.last_seen,
    )


class ConstrainedObjects(Objects):
    """The reducer under pairs of det_ids."""

    def __init__(
        self, fusion_radius_m: float, fusion_similarity: float, groups: PairGroups[DetId]
    ) -> None:
        super().__init__(fusion_radius_m, fusion_similarity)
        self._groups = groups
        self._object_of: dict[int, ObjectOrdinal] = {}  # group → its Object
        self._inside: dict[ObjectOrdinal, set[int]] = {}  # Object → the groups in it
        self._absorbed: set[ObjectOrdinal] = set()

    def fold_named(
        self,
        offset: Offset,
        seen: FusibleObservation,
        timestamp: float,
        x_um: int,
        y_um: int,
    ) -> list[ObjectFound | ObjectSeen | ObjectsMerged]:
        """Fuse one observation, as `Objects.fold`; an ObjectsMerged comes last."""
        _, det_id, class_name, *_ = seen
        group = self._groups.group_of.get(det_id)
        if group is None:
            return [*self.fold(offset, seen, timestamp, x_um, y_um)]
        own = self._object_of.get(group)
        inside = {group} if own is None else self._inside[own]
        free = [
            candidate
            for candidate in self.candidates_at(class_name, x_um, y_um)
            if candidate == own
            or not self._groups.are_apart(inside, self._inside.get(candidate, NO_GROUPS))
        ]
        fused = self.fold(offset, seen, timestamp, x_um, y_um, free, own)
        deltas: list[ObjectFound | ObjectSeen | ObjectsMerged] = [*fused]
        ordinal = fused[-1].object
        self._add_class(ordinal, class_name)
        self._inside.setdefault(ordinal, set()).add(group)
        self._object_of.setdefault(group, ordinal)
        if own is not None and ordinal != own:
            deltas.append(self._merge(offset, min(own, ordinal), max(own, ordinal)))
        return deltas

    def dump(self) -> State:
        """The whole state, to be kept."""
        return super().dump() | {
            "other_classes": [[*o.other_classes] for o in self.sums],
            "object_of": sorted(map(list, self._object_of.items())),
            "absorbed": sorted(self._absorbed),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        super().load(state)
        for index, classes in enumerate(state["other_classes"]):
            for class_name in classes:
                self._add_class(ObjectOrdinal(index), class_name)
        for ordinal in state["absorbed"]:
            self._absorbed.add(ordinal)
            self._unlist(ordinal, self.sums[ordinal])
        for group, ordinal in state["object_of"]:
            self._object_of[group] = ordinal
            self._inside.setdefault(ordinal, set()).add(group)

    def _merge(
        self, offset: Offset, survivor: ObjectOrdinal, absorbed: ObjectOrdinal
    ) -> ObjectsMerged:
        sums, other = self.sums[survivor], self.sums[absorbed]
        if sums.count + other.count > MAX_IN_A_SUM:
            raise OverflowError(
                f"objects {survivor} and {absorbed} have more than {MAX_IN_A_SUM} observations "
                "together, the bound of exact arithmetic"
            )
        before = sums.listed
        self._unlist(absorbed, other)
        self._absorbed.add(absorbed)
        dot = dot_of_sums(sums.vector_sum, sums.count, other.vector_sum, other.count)
        sums.norm2 += 2 * dot + other.norm2
        sums.vector_sum += other.vector_sum
        sums.count += other.count
        sums.sum_x_um += other.sum_x_um
        sums.sum_y_um += other.sum_y_um
        sums.first_seen = min(sums.first_seen, other.first_seen)
        sums.last_seen = max(sums.last_seen, other.last_seen)
        side = self._radius_um * sums.count
        sums.column, sums.row = sums.sum_x_um // side, sums.sum_y_um // side
        classes = (*sums.other_classes, other.class_name, *other.other_classes)
        sums.other_classes = tuple(c for c in dict.fromkeys(classes) if c != sums.class_name)
        self._list_again(survivor, before, sums)
        moved = self._inside.pop(absorbed, set())
        self._inside.setdefault(survivor, set()).update(moved)
        self._object_of |= dict.fromkeys(moved, survivor)
        return ObjectsMerged(
            offset,
            survivor,
            absorbed,
            sums.count,
            sums.sum_x_um,
            sums.sum_y_um,
            sums.first_seen,
            sums.last_seen,
        )

    def _add_class(self, ordinal: ObjectOrdinal, class_name: str) -> None:
        """Add a class of which the Object has a member."""
        sums = self.sums[ordinal]
        if class_name not in (sums.class_name, *sums.other_classes):
            before = sums.listed
            sums.other_classes += (class_name,)
            self._list_again(ordinal, before, sums)
