"""The history of a map: what happened to every place and object, and by which event.

`merges`, `why` and `bisect` are read from it without folding again. It holds no embeddings. The
place of a keyframe is found through the chain of absorptions (`History.place_at`), so a merge
costs nothing per member.

An ``end`` is a number of events: the answer is about the map after the events 0 … end − 1.
"""

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property

import numpy as np

from eventsrc.envelope.model import KeyframeId, Offset, RunId
from projections.fold.corrections import Corrections
from projections.fold.deltas import (
    EventSkipped,
    KeyframeAdded,
    KeyframeOrdinal,
    MapGiven,
    ObjectOrdinal,
    PlaceOrdinal,
    PlacesLinked,
    RunSeen,
)
from projections.fold.settings import Settings

from .neighbours import Neighbours
from .records import Cause, Merge, ObjectHistory, ObjectMerge, PlaceHistory, Refusal, last_before

NEVER = Offset(2**63 - 1)
"""The offset of an event that has not happened."""
NO_PLACE = PlaceOrdinal(-1)
"""The value of `History.placed_in` for a keyframe in no place."""


class SightingIndex:
    """The sightings of a history, each with its keyframe, in order of offset."""

    def __init__(self, history: "History") -> None:
        self._history = history
        seen = [(s.offset, s.object) for found in history.objects for s in found.sightings]
        seen.sort()
        self._offsets = [offset for offset, _ in seen]
        self._objects = np.array([thing for _, thing in seen], np.int64)
        self._keyframes = np.searchsorted(np.array(history.keyframe_offsets), self._offsets)
        self._placed_at = np.array(history.placed_offsets)
        self._placed_in = np.array(history.placed_in)

    def seen_from_all(self, places: Iterable[PlaceOrdinal], end: Offset) -> Sequence[ObjectOrdinal]:
        """The objects seen from every one of these places by the events below ``end``, as ascending
        ordinals."""
        count, history = bisect_left(self._offsets, end), self._history
        survivors: list[int] = [NO_PLACE] * len(history.places)
        for place, record in enumerate(history.places):
            if record.formed.offset < end:
                survivors[place] = history.survivor_of(PlaceOrdinal(place), end)
        keyframes = self._keyframes[:count]
        is_placed = self._placed_at[keyframes] < end
        joined = np.where(is_placed, self._placed_in[keyframes], 0)
        found = np.where(is_placed, np.array([*survivors, NO_PLACE])[joined], NO_PLACE)
        seen = [set(np.unique(self._objects[:count][found == place]).tolist()) for place in places]
        things = (
            {history.object_survivor(ObjectOrdinal(each), end) for each in from_one}
            for from_one in seen
        )
        return sorted(set.intersection(*things))


class History(ABC):
    """Everything that happened to places and objects in the events before ``next_offset``.

    By keyframe ordinal: ``keyframe_offsets`` is the event that added it, ``placed_offsets`` the
    event that placed it (`NEVER` for noise) and ``placed_in`` the place it joined then.
    ``corrections`` are those that the deltas were folded under.
    """

    settings: Settings
    corrections: Corrections
    next_offset: Offset
    keyframes: Sequence[KeyframeAdded]
    keyframe_offsets: Sequence[int]
    placed_offsets: Sequence[int]
    placed_in: Sequence[PlaceOrdinal]
    places: Sequence[PlaceHistory]
    objects: Sequence[ObjectHistory]
    merges: Sequence[Merge]
    refusals: Sequence[Refusal]
    object_merges: Sequence[ObjectMerge]
    runs: Sequence[Sequence[RunSeen]]
    skipped: Sequence[EventSkipped]
    maps: Sequence[MapGiven]
    edges: Mapping[tuple[PlaceOrdinal, PlaceOrdinal], Sequence[PlacesLinked]]
    keyframe_ordinals: Mapping[tuple[RunId, KeyframeId], KeyframeOrdinal]
    place_ordinals: Mapping[str, PlaceOrdinal]
    object_ordinals: Mapping[str, ObjectOrdinal]

    @property
    @abstractmethod
    def neighbours(self) -> Neighbours:
        """The index of keyframes within ε of each other."""

    @cached_property
    def sighting_index(self) -> SightingIndex:
        """The index of sightings."""
        return SightingIndex(self)

    def place_at(self, keyframe: KeyframeOrdinal, end: Offset | None = None) -> PlaceOrdinal | None:
        """The place a keyframe is in after the events below ``end`` (default: all so far)."""
        end = self.next_offset if end is None else end
        if self.placed_offsets[keyframe] >= end:
            return None
        return self.survivor_of(self.placed_in[keyframe], end)

    def survivor_of(self, place: PlaceOrdinal, end: Offset | None = None) -> PlaceOrdinal:
        """The place that ``place`` is part of after the events below ``end`` (default: all)."""
        end = self.next_offset if end is None else end
        while (merge := self.places[place].absorbed_by) is not None and merge.cause.offset < end:
            place = merge.survivor
        return place

    def object_survivor(self, found: ObjectOrdinal, end: Offset) -> ObjectOrdinal:
        """The object that ``found`` is part of after the events below ``end``."""
        while (merge := self.objects[found].absorbed_by) is not None and merge.offset < end:
            found = merge.survivor
        return found

    @abstractmethod
    def keyframe_count(self, end: Offset) -> int:
        """Keyframes added by the events below ``end``."""

    @abstractmethod
    def posed_offsets(self) -> Sequence[int]:
        """The events that added keyframes with a pose, in order."""

    @abstractmethod
    def offsets_by_run(self) -> Mapping[str, Sequence[int]]:
        """By run the events that added its keyframes, in order."""

    @abstractmethod
    def cause_at(self, offset: Offset) -> Cause:
        """The event at ``offset`` as a cause."""

    def transitions(self, a: PlaceOrdinal, b: PlaceOrdinal, end: Offset) -> int:
        """Shared transitions of two places after the events below ``end``."""
        pair = (min(a, b), max(a, b))
        linked = last_before(self.edges.get(pair, ()), end)
        return 0 if linked is None else linked.shared_transitions
