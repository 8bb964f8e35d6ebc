"""The history of a map: what happened to every place and object, and by which event.

`merges`, `why` and `bisect` are read from it without folding again. It holds no embeddings. The
place of a keyframe is found through the chain of absorptions (`History.place_at`), so a merge
costs nothing per member.

An ``end`` is a number of events: the answer is about the map after the events 0 … end − 1.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from itertools import starmap
from typing import Final, cast

import numpy as np

from eventsrc.envelope.model import KeyframeId, Offset, RunId
from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.corrections import Corrections
from projections.fold.deltas import (
    EventSkipped,
    KeyframeAdded,
    KeyframeOrdinal,
    KeyframePlaced,
    MapGiven,
    ObjectClassified,
    ObjectEstimated,
    ObjectFound,
    ObjectMissing,
    ObjectMoved,
    ObjectOrdinal,
    ObjectRelocated,
    ObjectSeen,
    PlaceChanged,
    PlaceFormed,
    PlaceNamed,
    PlaceOrdinal,
    PlacesLinked,
    RunSeen,
)
from projections.fold.settings import Settings

from .history_rows import (
    NO_PLACE,
    as_ints,
    documents,
    items_of,
    keyframes_of,
    placed_columns,
    posed,
)
from .lazy_rows import Chunks, OrdinalsByName
from .neighbours import Neighbours
from .records import Cause, Merge, ObjectHistory, ObjectMerge, PlaceHistory, Refusal, last_before
from .tables import Groups, Tables

MapAt = Callable[[Offset], OccupancyMap]
"""Reads the occupancy map that the event at an offset is."""

_OBJECT_LISTS: Final = {
    "sightings": ("seen", ObjectSeen),
    "moves": ("moved", ObjectMoved),
    "estimates": ("estimated", ObjectEstimated),
    "classes": ("classified", ObjectClassified),
    "misses": ("missing", ObjectMissing),
    "relocations": ("relocated", ObjectRelocated),
}


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
    """Everything that happened to places and objects in the events in ``tables``; read-only.

    Each attribute is made from the tables when it is first read. By keyframe ordinal:
    ``keyframe_offsets`` is the event that added it, ``placed_offsets`` the event that placed it
    (`NEVER` for noise) and ``placed_in`` the place it joined then. ``corrections`` are those that
    the deltas were folded under.
    """

    def __init__(
        self, settings: Settings, corrections: Corrections, tables: Tables, map_at: MapAt
    ) -> None:
        self.settings = settings
        self.corrections = corrections
        self.next_offset = tables.end
        self.tables = tables
        self.map_at = map_at

    @cached_property
    def keyframes(self) -> Sequence[KeyframeAdded]:
        """The keyframes by ordinal."""
        tables = self.tables
        return Chunks(tables.count("keyframe"), partial(keyframes_of, tables))

    @cached_property
    def keyframe_offsets(self) -> Sequence[int]:
        """By keyframe the event that added it."""
        return as_ints(self.tables.integers("keyframe", "offset"))

    @cached_property
    def placed_offsets(self) -> Sequence[int]:
        """By keyframe the event that placed it, `NEVER` for noise."""
        return as_ints(placed_columns(self.tables)[0])

    @cached_property
    def placed_in(self) -> Sequence[PlaceOrdinal]:
        """By keyframe the place that it joined."""
        return cast("Sequence[PlaceOrdinal]", as_ints(placed_columns(self.tables)[1]))

    @cached_property
    def places(self) -> Sequence[PlaceHistory]:
        """What happened to each place."""
        tables = self.tables
        places = []
        rows = tables.rows("formed", 0, tables.count("formed"))
        causes = self.causes_at([row[0] for row in rows])
        for number, (row, cause) in enumerate(zip(rows, causes, strict=True)):
            place = PlaceHistory(PlaceFormed(row[0], PlaceOrdinal(number), *row[1:]), cause)
            place.joined = items_of(tables, "placed", "place", KeyframePlaced, number)
            place.changes = items_of(tables, "changed", "place", PlaceChanged, number)
            place.names = items_of(tables, "named", "place", PlaceNamed, number)
            places.append(place)
        for merge in self.merges:
            places[merge.survivor].merges.append(merge)
            for absorbed in merge.absorbed:
                places[absorbed].absorbed_by = merge
        return places

    @cached_property
    def objects(self) -> Sequence[ObjectHistory]:
        """What happened to each object."""
        tables = self.tables
        objects = []
        rows = tables.rows("found", 0, tables.count("found"))
        causes = self.causes_at([row[0] for row in rows])
        for number, (row, cause) in enumerate(zip(rows, causes, strict=True)):
            record = ObjectHistory(ObjectFound(row[0], ObjectOrdinal(number), *row[1:]), cause)
            for name, (table, delta) in _OBJECT_LISTS.items():
                setattr(record, name, items_of(tables, table, "object", delta, number))
            objects.append(record)
        for merge in self.object_merges:
            objects[merge.survivor].merges.append(merge)
            objects[merge.absorbed].absorbed_by = merge
        return objects

    @cached_property
    def runs(self) -> Sequence[Sequence[RunSeen]]:
        """Each run as it was seen."""
        tables = self.tables
        runs: list[list[RunSeen]] = []
        for seen in starmap(RunSeen, tables.rows("run", 0, tables.count("run"))):
            if seen.run == len(runs):
                runs.append([])
            runs[seen.run].append(seen)
        return runs

    @cached_property
    def skipped(self) -> Sequence[EventSkipped]:
        """What was left out."""
        tables = self.tables
        return Chunks(
            tables.count("skipped"),
            lambda a, b: list(starmap(EventSkipped, tables.rows("skipped", a, b))),
        )

    @cached_property
    def maps(self) -> Sequence[MapGiven]:
        """The occupancy maps."""
        offsets = self.tables.column("map", "offset").tolist() if self.tables.count("map") else []
        return [MapGiven(Offset(offset), self.map_at(Offset(offset))) for offset in offsets]

    @cached_property
    def edges(self) -> Mapping[tuple[PlaceOrdinal, PlaceOrdinal], Sequence[PlacesLinked]]:
        """By pair of places their shared transitions in order."""
        tables = self.tables
        edges: dict[tuple[PlaceOrdinal, PlaceOrdinal], list[PlacesLinked]] = {}
        for linked in starmap(PlacesLinked, tables.rows("linked", 0, tables.count("linked"))):
            edges.setdefault((linked.a, linked.b), []).append(linked)
        return edges

    @cached_property
    def keyframe_ordinals(self) -> Mapping[tuple[RunId, KeyframeId], KeyframeOrdinal]:
        """The keyframes by run and id."""
        tables = self.tables
        runs = {seen[0].run_id: number for number, seen in enumerate(self.runs)}

        def find(name: tuple[RunId, KeyframeId]) -> int | None:
            run_id, keyframe_id = name
            if run_id not in runs:
                return None
            same = tables.column("keyframe", "keyframe_id") == keyframe_id
            found = np.flatnonzero(same & (tables.column("keyframe", "run") == runs[run_id]))
            return int(found[-1]) if len(found) else None

        def names() -> Iterator[tuple[RunId, KeyframeId]]:
            return ((k.run_id, k.keyframe_id) for k in self.keyframes)

        return OrdinalsByName(tables.count("keyframe"), find, names)

    @cached_property
    def merges(self) -> Sequence[Merge]:
        """The merges of places."""
        return documents(self.tables, "merge", Merge)

    @cached_property
    def refusals(self) -> Sequence[Refusal]:
        """The merges that commands refused."""
        return documents(self.tables, "refusal", Refusal)

    @cached_property
    def object_merges(self) -> Sequence[ObjectMerge]:
        """The merges of objects."""
        return documents(self.tables, "object_merge", ObjectMerge)

    @cached_property
    def place_ordinals(self) -> Mapping[str, PlaceOrdinal]:
        """The places by id."""
        texts = self.tables.texts("formed", "place_id", 0, self.tables.count("formed"))
        return {text or "": PlaceOrdinal(number) for number, text in enumerate(texts)}

    @cached_property
    def object_ordinals(self) -> Mapping[str, ObjectOrdinal]:
        """The objects by id."""
        texts = self.tables.texts("found", "object_id", 0, self.tables.count("found"))
        return {text or "": ObjectOrdinal(number) for number, text in enumerate(texts)}

    @cached_property
    def neighbours(self) -> Neighbours:
        """The index of keyframes within ε of each other."""
        return Neighbours(posed(self.tables), self.settings)

    def keyframe_count(self, end: Offset) -> int:
        """Keyframes added by the events below ``end``."""
        return self.tables.before("keyframe", end)

    def posed_offsets(self) -> Sequence[int]:
        """The events that added keyframes with a pose, in order."""
        posed = self.tables.column("keyframe", "posed").astype(np.bool_)
        return as_ints(self.tables.integers("keyframe", "offset")[posed])

    def offsets_by_run(self) -> Mapping[str, Sequence[int]]:
        """By run the events that added its keyframes, in order."""
        offsets = self.tables.integers("keyframe", "offset")
        by_run = Groups(self.tables.column("keyframe", "run"), offsets)
        found = {seen[0].run_id: by_run[number] for number, seen in enumerate(self.runs)}
        return {run_id: as_ints(of) for run_id, of in found.items() if len(of)}

    def cause_at(self, offset: Offset) -> Cause:
        """The event at ``offset`` as a cause."""
        (cause,) = self.causes_at([offset])
        return cause

    def causes_at(self, offsets: Sequence[Offset]) -> list[Cause]:
        """`cause_at` for many offsets."""
        tables, keyframes = self.tables, np.asarray(self.keyframe_offsets)
        asked = np.array(offsets, np.int64)
        rows = np.searchsorted(keyframes, asked)
        found = np.searchsorted(keyframes, asked, "right") > rows
        numbers = rows[found]
        values = zip(
            tables.column("keyframe", "timestamp")[numbers].tolist(),
            tables.column("keyframe", "run")[numbers].tolist(),
            tables.column("keyframe", "keyframe_id")[numbers].tolist(),
            strict=True,
        )
        causes = []
        for offset, is_keyframe in zip(offsets, found.tolist(), strict=True):
            if is_keyframe:
                time_s, run, keyframe_id = next(values)
                run_id = self.runs[run][0].run_id
                causes.append(Cause(offset, "keyframe", time_s, run_id, keyframe_id))
            else:
                causes.append(Cause(offset, "command"))
        return causes

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

    def transitions(self, a: PlaceOrdinal, b: PlaceOrdinal, end: Offset) -> int:
        """Shared transitions of two places after the events below ``end``."""
        pair = (min(a, b), max(a, b))
        linked = last_before(self.edges.get(pair, ()), end)
        return 0 if linked is None else linked.shared_transitions
