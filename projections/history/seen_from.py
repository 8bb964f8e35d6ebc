"""Objects that keyframes of several places saw, for telling what places have in common."""

from array import array
from bisect import bisect_left
from collections.abc import Iterable, MutableSequence, Sequence
from typing import Protocol

import numpy as np

from eventsrc.envelope import Offset
from projections.deltas import ObjectOrdinal, PlaceOrdinal

from .records import ObjectHistory, PlaceHistory

_NOWHERE = -1


class _Known(Protocol):
    """What of a `History` is used."""

    objects: list[ObjectHistory]
    places: list[PlaceHistory]
    keyframe_offsets: "array[int]"
    placed_offsets: "array[int]"
    placed_in: MutableSequence[PlaceOrdinal]

    def survivor_of(self, place: PlaceOrdinal, end: Offset | None = None) -> PlaceOrdinal: ...

    def object_survivor(self, found: ObjectOrdinal, end: Offset) -> ObjectOrdinal: ...


class SeenFrom:
    """The sightings of a history so far, each with its keyframe, in order of offset."""

    def __init__(self, history: _Known) -> None:
        self._history = history
        seen = [(s.offset, s.object) for found in history.objects for s in found.sightings]
        seen.sort()
        self._offsets = [offset for offset, _ in seen]
        self._objects = np.array([thing for _, thing in seen], np.int64)
        self._keyframes = np.searchsorted(np.array(history.keyframe_offsets), self._offsets)
        self._placed_at = np.array(history.placed_offsets)
        self._placed_in = np.array(history.placed_in)

    def from_all(self, places: Iterable[PlaceOrdinal], end: Offset) -> Sequence[ObjectOrdinal]:
        """The objects that keyframes of each of these places saw by the events below ``end``, by
        their ordinals."""
        count, history = bisect_left(self._offsets, end), self._history
        survivors = [_NOWHERE] * len(history.places)
        for place, record in enumerate(history.places):
            if record.formed.offset < end:
                survivors[place] = history.survivor_of(PlaceOrdinal(place), end)
        keyframes = self._keyframes[:count]
        is_placed = self._placed_at[keyframes] < end
        joined = np.where(is_placed, self._placed_in[keyframes], 0)
        found = np.where(is_placed, np.array([*survivors, _NOWHERE])[joined], _NOWHERE)
        seen = [set(np.unique(self._objects[:count][found == place]).tolist()) for place in places]
        things = (
            {history.object_survivor(ObjectOrdinal(each), end) for each in from_one}
            for from_one in seen
        )
        return sorted(set.intersection(*things))
