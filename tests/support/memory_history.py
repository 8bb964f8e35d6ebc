"""The history of a map as records in memory, made from deltas: what tests compare tables with."""

from array import array
from bisect import bisect_left
from collections.abc import Callable, Mapping, MutableSequence, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from msgspec.structs import astuple

from eventsrc.envelope.model import FIRST_OFFSET, KeyframeId, Offset, RunId
from projections.fold import packed
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.deltas import (
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
from projections.fold.settings import Settings
from projections.map.records import EstimatedPosition, ObjectRecord, Relocation
from projections.map.view import MapView
from projections.store.history import NEVER, NO_PLACE, History
from projections.store.history_records import (
    Cause,
    EdgeChange,
    Merge,
    ObjectHistory,
    ObjectMerge,
    PlaceHistory,
    RefusedMerge,
    cause_of,
    count_before,
    last_before,
)
from projections.store.neighbours import Neighbours, Posed


@dataclass(frozen=True, slots=True)
class _Move:
    object: ObjectOrdinal
    before: PlaceOrdinal | None


class MemoryHistory(History):
    """A `History` that is fed the deltas of each event, in order; questions come after them."""

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
        self.refusals: list[RefusedMerge] = []
        self.object_merges: list[ObjectMerge] = []
        self.runs: list[list[RunSeen]] = []
        self.skipped: list[EventSkipped] = []
        self.maps: list[MapGiven] = []
        self.edges: dict[tuple[PlaceOrdinal, PlaceOrdinal], list[PlacesLinked]] = {}
        self.keyframe_ordinals: dict[tuple[RunId, KeyframeId], KeyframeOrdinal] = {}
        self.place_ordinals: dict[str, PlaceOrdinal] = {}
        self.object_ordinals: dict[str, ObjectOrdinal] = {}
        self._view = MapView(settings, keep_embeddings=False, corrections=corrections)
        self._confirmed: dict[ObjectOrdinal, Offset] = {}
        """The event that confirmed an object."""

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
        self._view.apply_event(offset, deltas)
        for each in self._view.all_objects:
            if each.confirmed:
                self._confirmed.setdefault(each.ordinal, offset)

    @cached_property
    def neighbours(self) -> Neighbours:
        return Neighbours(posed(self.keyframes), self.settings)

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

    def object_at(self, found: ObjectOrdinal, end: Offset) -> ObjectRecord:
        """What an object is after the events below ``end``."""
        record = object_of(self.objects[found], end)
        record.confirmed = self._confirmed.get(found, end) < end
        return record

    def objects_at(self, end: Offset) -> list[ObjectRecord]:
        """`object_at` of all objects found by the events below ``end``."""
        found = [each.found for each in self.objects if each.found.offset < end]
        return [self.object_at(each.object, end) for each in found]

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
        refused = RefusedMerge(cause, delta.a, delta.b, delta.bridge, delta.link, delta.apart)
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
    _APPLIERS: ClassVar[dict[type, Callable[["MemoryHistory", Any, Cause], None]]] = {
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


def posed(keyframes: Sequence[KeyframeAdded]) -> Posed:
    """The posed keyframes among these records."""
    found = [(k, k.pose) for k in keyframes if k.pose is not None]
    names: dict[str | None, int] = {}
    return Posed(
        np.array([k.keyframe for k, _ in found], np.int64),
        np.array([k.offset for k, _ in found], np.int64),
        np.array([(at.x_um, at.y_um) for _, at in found], np.int64).reshape(-1, 2),
        np.array([names.setdefault(k.floor, len(names)) for k, _ in found], np.int64),
    )


def object_of(history: ObjectHistory, end: Offset) -> ObjectRecord:
    """What an object is after the events below ``end``, by its deltas one by one."""
    found, seen = history.found, history.sightings[: count_before(history.sightings, end)]
    record = ObjectRecord(found.object, found.object_id, found.class_name)
    if (classified := last_before(history.classes, end)) is not None:
        record.class_name = classified.class_name
    record.observations = [delta.observation for delta in seen]
    last: ObjectSeen | ObjectsMerged | None = seen[-1] if seen else None
    merged = last_before(history.merges, end)
    if merged is not None and not (last and last.obs_count > merged.values.obs_count):
        last = merged.values
    if last is not None:
        record.obs_count = last.obs_count
        record.sum_x_um, record.sum_y_um = last.sum_x_um, last.sum_y_um
        record.first_seen, record.last_seen = last.first_seen, last.last_seen
    if (moved := last_before(history.moves, end)) is not None:
        record.place = moved.place
    if (estimated := last_before(history.estimates, end)) is not None:
        _, _, *values = astuple(estimated)
        record.estimate = EstimatedPosition(*values)
    again = last_before(history.relocations, end)
    looked = last_before(history.misses, end)
    if looked is not None and not (again and again.offset > looked.offset):
        record.misses = looked.misses
        record.missing_in = looked.run if looked.missing else None
    for each in history.relocations[: count_before(history.relocations, end)]:
        offset, _, *values = astuple(each)
        record.relocations.append(Relocation(offset, *values))
    return record
