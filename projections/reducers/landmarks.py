"""Landmarks: repeated sightings fused into Objects.

The rules (DESIGN section 5), for an observation of class C made from the pose (x, y):

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
count · 2⁴⁰; `projections.exact` says how it is multiplied exactly, and its bound. A sum of zero, of
opposite looks, has no direction; its cosine with anything is 0.

Every Object is listed in the nine grid cells of side ``fusion_radius_m`` around its mean, so one
look-up finds all candidates however large the map is.
"""

import hashlib
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope import Offset
from projections.deltas import ObjectFound, ObjectSeen
from projections.exact import MAX_IN_A_SUM, MAX_IN_ONE_DOT, Q40, long_dot, metres_to_um
from projections.reducers import State

Bucket = tuple[str, int, int]


@dataclass(slots=True, eq=False)
class Landmark:
    """An Object: sums of positions, µm, and of unit vectors, integers in float64, shape (dim,)."""

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


def object_id(det_id: str) -> str:
    """The id of the Object that the observation ``det_id`` founds."""
    return "obj-" + hashlib.sha256(det_id.encode()).hexdigest()[:16]


class Landmarks:
    """The reducer."""

    def __init__(self, fusion_radius_m: float, fusion_similarity: float) -> None:
        self._radius_um = max(metres_to_um(fusion_radius_m), 1)
        self._least_q40 = fusion_similarity * Q40
        self.objects: list[Landmark] = []
        self._near: dict[Bucket, list[int]] = {}

    def fold(
        self,
        offset: Offset,
        observation: int,
        det_id: str,
        class_name: str,
        vector: NDArray[np.float64],
        norm2: int,
        timestamp: float,
        x_um: int,
        y_um: int,
    ) -> list[ObjectFound | ObjectSeen]:
        """Fuse one observation. ``vector`` and ``norm2`` are of its unit vector, `exact.Units`."""
        radius_um, objects = self._radius_um, self.objects
        column, row = x_um // radius_um, y_um // radius_um
        winner, best_q40, best_dot = -1, -math.inf, 0
        for candidate in self._near.get((class_name, column, row), ()):
            landmark = objects[candidate]
            count = landmark.count
            dx = landmark.sum_x_um - x_um * count
            dy = landmark.sum_y_um - y_um * count
            if dx * dx + dy * dy > (radius_um * count) ** 2:
                continue
            if count <= MAX_IN_ONE_DOT:
                dot = int(landmark.vector_sum.dot(vector))
            else:
                dot = long_dot(landmark.vector_sum, vector)
            # Both conversions, √ and ÷ are correctly rounded.
            q40 = round(dot / math.sqrt(landmark.norm2 * norm2 or 1) * Q40)
            if q40 > best_q40 or (q40 == best_q40 and candidate < winner):
                winner, best_q40, best_dot = candidate, q40, dot
        if winner < 0 or best_q40 < self._least_q40:
            founded = Landmark(
                class_name, vector.copy(), norm2, 1, x_um, y_um, timestamp, timestamp, column, row
            )
            return self._found(offset, observation, det_id, founded)
        landmark = objects[winner]
        if landmark.count >= MAX_IN_A_SUM:
            raise OverflowError(
                f"object {winner} of class {class_name!r} has {MAX_IN_A_SUM} observations, "
                "the bound of its exact arithmetic"
            )
        landmark.vector_sum += vector
        landmark.norm2 += 2 * best_dot + norm2
        self._update(winner, landmark, timestamp, x_um, y_um)
        return [_seen(offset, winner, observation, int(best_q40), landmark)]

    def dump(self) -> State:
        """Everything, for a snapshot. The vectors' sums are one matrix, a row for each Object."""
        objects = self.objects
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
        """Take over what `dump` gave."""
        for index, (first, last) in enumerate(state["seen"].tolist()):
            landmark = Landmark(
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
            self.objects.append(landmark)
            self._list(index, landmark)

    def _found(
        self, offset: Offset, observation: int, det_id: str, landmark: Landmark
    ) -> list[ObjectFound | ObjectSeen]:
        ordinal = len(self.objects)
        self.objects.append(landmark)
        self._list(ordinal, landmark)
        found = ObjectFound(offset, ordinal, object_id(det_id), landmark.class_name, observation)
        return [found, _seen(offset, ordinal, observation, Q40, landmark)]

    def _update(
        self, ordinal: int, landmark: Landmark, timestamp: float, x_um: int, y_um: int
    ) -> None:
        landmark.count += 1
        landmark.sum_x_um += x_um
        landmark.sum_y_um += y_um
        if timestamp > landmark.last_seen:
            landmark.last_seen = timestamp
        elif timestamp < landmark.first_seen:
            landmark.first_seen = timestamp
        side = self._radius_um * landmark.count
        column, row = landmark.sum_x_um // side, landmark.sum_y_um // side
        if (column, row) != (landmark.column, landmark.row):
            for bucket in _buckets(landmark):
                self._near[bucket].remove(ordinal)
            landmark.column, landmark.row = column, row
            self._list(ordinal, landmark)

    def _list(self, ordinal: int, landmark: Landmark) -> None:
        for bucket in _buckets(landmark):
            self._near.setdefault(bucket, []).append(ordinal)


def _buckets(landmark: Landmark) -> list[Bucket]:
    return [
        (landmark.class_name, landmark.column + dx, landmark.row + dy)
        for dx in (-1, 0, 1)
        for dy in (-1, 0, 1)
    ]


def _seen(
    offset: Offset, ordinal: int, observation: int, similarity_q40: int, landmark: Landmark
) -> ObjectSeen:
    return ObjectSeen(
        offset,
        ordinal,
        observation,
        similarity_q40,
        landmark.count,
        landmark.sum_x_um,
        landmark.sum_y_um,
        landmark.first_seen,
        landmark.last_seen,
    )
