"""The history of a map: what happened to every place and object, and by which event.

`History` is fed the deltas of each event, in order. `merges`, `why`, `bisect` and a map at any
offset (`past_view`) are read from it without folding again. It holds no embeddings. The place of a
keyframe is found through the chain of absorptions (`History.place_at`), so a merge costs nothing
per member.

An ``end`` is a number of events: the answer is about the map after the events 0 … end − 1.
"""

from array import array
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, MutableSequence, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from eventsrc.envelope import FIRST_OFFSET, KeyframeId, Offset, RunId
from projections.corrections import NO_CORRECTIONS, Corrections
from projections.deltas import (
    Delta,
    EventSkipped,
    KeyframeAdded,
    KeyframeOrdinal,
    KeyframePlaced,
    MapGiven,
    MergeRefused,
    ObjectClassified,
    ObjectEstimated,
    ObjectFound,
    ObjectMissing,
    ObjectMoved,
    ObjectOrdinal,
    ObjectRelocated,
    ObjectSeen,
    ObjectsMerged,
    PlaceChanged,
    PlaceFormed,
    PlaceNamed,
    PlaceOrdinal,
    PlacesLinked,
    PlacesMerged,
    RunSeen,
)
from projections.reducers import packed
from projections.settings import Settings

from .neighbours import Neighbours, Posed
from .records import (
    Cause,
    EdgeChange,
    Merge,
    ObjectHistory,
    ObjectMerge,
    PlaceHistory,
    Refusal,
    cause_of,
    last_before,
)

NEVER = Offset(2**63 - 1)
"""The offset of an event that has not happened."""
NO_PLACE = PlaceOrdinal(-1)
"""The value of `History.placed_in` for a keyframe in no place."""


@dataclass(frozen=True, slots=True)
class _Move:
    object: ObjectOrdinal
    before: PlaceOrdinal | None


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


class History:
    """Everything that happened to places and objects in the events applied so far.

    By keyframe ordinal: ``keyframe_offsets`` is the event that added it, ``placed_offsets`` the
    event that placed it (`NEVER` for noise) and ``placed_in`` the place it joined then.
    ``corrections`` are those that the deltas were folded under.
    """

    def __init__(self, settings: Settings, corrections: Corrections = NO_CORRECTIONS) -> None:
        self.settings = settings
        self.corrections = corrections
        self.next_offset = FIRST_OFFSET
        self.keyframes: list[KeyframeAdded] = []
        self.keyframe_offsets = array("q")
        self.placed_offsets = array("q")
        self.placed_in: MutableSequence[PlaceOrdinal] = packed("q")
        self.places: list[PlaceHistory] = []
        self.objects: list[ObjectHistory] = []
        self.merges: list[Merge] = []
        self.refusals: list[Refusal] = []
        self.object_merges: list[ObjectMerge] = []
        self.runs: list[list[RunSeen]] = []
        self.skipped: list[EventSkipped] = []
        self.maps: list[MapGiven] = []
        self.edges: dict[tuple[PlaceOrdinal, PlaceOrdinal], list[PlacesLinked]] = {}
        self.keyframe_ordinals: dict[tuple[RunId, KeyframeId], KeyframeOrdinal] = {}
        self.place_ordinals: dict[str, PlaceOrdinal] = {}
        self.object_ordinals: dict[str, ObjectOrdinal] = {}
        self._neighbours: tuple[int, Neighbours] | None = None
        self._sighting_index: tuple[Offset, SightingIndex] | None = None

    def apply(self, offset: Offset, deltas: Sequence[Delta]) -> None:
        """Add the deltas of the event at ``offset``."""
        self.next_offset = Offset(offset + 1)
        if not deltas:
            return
        cause = cause_of(offset, deltas)
        merges: list[PlacesMerged] = []
        moves: list[_Move] = []
        links: list[EdgeChange] = []
        for delta in deltas:
            if (handle := self._APPLIERS.get(type(delta))) is not None:
                handle(self, delta, cause)
            elif isinstance(delta, PlacesMerged):
                merges.append(delta)
            elif isinstance(delta, ObjectMoved):
                moves.append(self._object_moved(delta))
            elif isinstance(delta, PlacesLinked):
                links.append(self._places_linked(delta))
        for merge in merges:
            self._places_merged(merge, cause, moves, links)

    @property
    def neighbours(self) -> Neighbours:
        """The index of keyframes within ε of each other; rebuilt after new events."""
        count = len(self.keyframes)
        if self._neighbours is None or self._neighbours[0] != count:
            self._neighbours = count, Neighbours(Posed.of(self.keyframes), self.settings)
        return self._neighbours[1]

    @property
    def sighting_index(self) -> SightingIndex:
        """The index of sightings; rebuilt after new events."""
        if self._sighting_index is None or self._sighting_index[0] != self.next_offset:
            self._sighting_index = self.next_offset, SightingIndex(self)
        return self._sighting_index[1]

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

    def keyframe_count(self, end: Offset) -> int:
        """Keyframes added by the events below ``end``."""
        return bisect_left(self.keyframe_offsets, end)

    def posed_offsets(self) -> Sequence[int]:
        """The events that added keyframes with a pose, in order."""
        return array("q", (k.offset for k in self.keyframes if k.pose is not None))

    def offsets_by_run(self) -> Mapping[str, Sequence[int]]:
        """By run the events that added its keyframes, in order."""
        found: dict[str, array[int]] = {}
        for keyframe in self.keyframes:
            found.setdefault(keyframe.run_id, array("q")).append(keyframe.offset)
        return found

    def cause_at(self, offset: Offset) -> Cause:
        """The event at ``offset`` as a cause."""
        number = bisect_left(self.keyframe_offsets, offset)
        added = self.keyframes[number : number + 1]
        return cause_of(offset, [k for k in added if k.offset == offset])

    def transitions(self, a: PlaceOrdinal, b: PlaceOrdinal, end: Offset) -> int:
        """Shared transitions of two places after the events below ``end``."""
        pair = (min(a, b), max(a, b))
        linked = last_before(self.edges.get(pair, ()), end)
        return 0 if linked is None else linked.shared_transitions

    def _run_seen(self, delta: RunSeen, _: Cause) -> None:
        if delta.run == len(self.runs):
            self.runs.append([])
        self.runs[delta.run].append(delta)

    def _keyframe_added(self, delta: KeyframeAdded, _: Cause) -> None:
        self.keyframe_ordinals[delta.run_id, delta.keyframe_id] = delta.keyframe
        self.keyframes.append(delta)
        self.keyframe_offsets.append(delta.offset)
        self.placed_offsets.append(NEVER)
        self.placed_in.append(NO_PLACE)

    def _event_skipped(self, delta: EventSkipped, _: Cause) -> None:
        self.skipped.append(delta)

    def _map_given(self, delta: MapGiven, _: Cause) -> None:
        self.maps.append(delta)

    def _place_formed(self, delta: PlaceFormed, cause: Cause) -> None:
        self.place_ordinals[delta.place_id] = delta.place
        self.places.append(PlaceHistory(delta, cause))

    def _keyframe_placed(self, delta: KeyframePlaced, _: Cause) -> None:
        self.placed_offsets[delta.keyframe] = delta.offset
        self.placed_in[delta.keyframe] = delta.place
        self.places[delta.place].joined.append(delta)

    def _place_changed(self, delta: PlaceChanged, _: Cause) -> None:
        self.places[delta.place].changes.append(delta)

    def _place_named(self, delta: PlaceNamed, _: Cause) -> None:
        self.places[delta.place].names.append(delta)

    def _merge_refused(self, delta: MergeRefused, cause: Cause) -> None:
        refused = Refusal(cause, delta.a, delta.b, delta.bridge, delta.link, delta.apart)
        self.refusals.append(refused)

    def _objects_merged(self, delta: ObjectsMerged, cause: Cause) -> None:
        merge = ObjectMerge(cause, delta)
        self.object_merges.append(merge)
        self.objects[delta.survivor].merges.append(merge)
        self.objects[delta.absorbed].absorbed_by = merge

    def _object_found(self, delta: ObjectFound, cause: Cause) -> None:
        self.object_ordinals[delta.object_id] = delta.object
        self.objects.append(ObjectHistory(delta, cause))

    def _object_seen(self, delta: ObjectSeen, _: Cause) -> None:
        self.objects[delta.object].sightings.append(delta)

    def _object_estimated(self, delta: ObjectEstimated, _: Cause) -> None:
        self.objects[delta.object].estimates.append(delta)

    def _object_classified(self, delta: ObjectClassified, _: Cause) -> None:
        self.objects[delta.object].classes.append(delta)

    def _object_missing(self, delta: ObjectMissing, _: Cause) -> None:
        self.objects[delta.object].misses.append(delta)

    def _object_relocated(self, delta: ObjectRelocated, _: Cause) -> None:
        self.objects[delta.object].relocations.append(delta)

    # Functions of the class, not methods bound to the history, as in `MapView`.
    _APPLIERS: ClassVar[dict[type, Callable[["History", Any, Cause], None]]] = {
        RunSeen: _run_seen,
        KeyframeAdded: _keyframe_added,
        EventSkipped: _event_skipped,
        MapGiven: _map_given,
        PlaceFormed: _place_formed,
        KeyframePlaced: _keyframe_placed,
        PlaceChanged: _place_changed,
        PlaceNamed: _place_named,
        MergeRefused: _merge_refused,
        ObjectsMerged: _objects_merged,
        ObjectFound: _object_found,
        ObjectSeen: _object_seen,
        ObjectEstimated: _object_estimated,
        ObjectClassified: _object_classified,
        ObjectMissing: _object_missing,
        ObjectRelocated: _object_relocated,
    }

    def _object_moved(self, delta: ObjectMoved) -> _Move:
        moves = self.objects[delta.object].moves
        move = _Move(delta.object, moves[-1].place if moves else None)
        moves.append(delta)
        return move

    def _places_linked(self, delta: PlacesLinked) -> EdgeChange:
        linked = self.edges.setdefault((delta.a, delta.b), [])
        before = linked[-1].shared_transitions if linked else 0
        linked.append(delta)
        return EdgeChange(delta.a, delta.b, before, delta.shared_transitions)

    def _places_merged(
        self, delta: PlacesMerged, cause: Cause, moves: list[_Move], links: list[EdgeChange]
    ) -> None:
        places = {delta.survivor, *delta.absorbed}
        merge = Merge(
            number=len(self.merges) + 1,
            cause=cause,
            bridge=delta.bridge,
            survivor=delta.survivor,
            survivor_size=delta.survivor_count,
            absorbed=delta.absorbed,
            absorbed_sizes=delta.absorbed_counts,
            links=delta.links,
            objects=tuple(move.object for move in moves if move.before in delta.absorbed),
            edges=tuple(link for link in links if link.a in places or link.b in places),
            joined=delta.joined,
            drives=delta.drives,
        )
        self.merges.append(merge)
        self.places[delta.survivor].merges.append(merge)
        for place in delta.absorbed:
            self.places[place].absorbed_by = merge
