"""The history of a map: what happened to every place and object, and by which event.

`merges`, `why` and `bisect` are read from it without folding again. It holds no embeddings. The
place of a keyframe is found through the chain of absorptions (`History.place_at`), so a merge
costs nothing per member.

An ``end`` is a number of events: the answer is about the map after the events 0 … end − 1.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, Final, cast

import msgspec
import numpy as np

from eventsrc.envelope.model import KeyframeId, Offset, RunId
from eventsrc.envelope.occupancy_map import OccupancyMap, decode_map
from projections.fold import deltas as d
from projections.fold.corrections import Corrections
from projections.fold.settings import Settings
from projections.map.records import ObjectRecord

from . import history_records
from .columns import Array
from .history_records import Chunks, Items, OrdinalsByName
from .neighbours import Neighbours, posed
from .object_states import ObjectStates
from .tables import Groups, Tables

NEVER: Final = Offset(2**63 - 1)
"""The offset of an event that has not happened."""
NO_PLACE: Final = d.PlaceOrdinal(-1)
"""The value of `History.placed_in` for a keyframe in no place."""
_MOST_STATES: Final = 64

MapAt = Callable[[Offset], OccupancyMap]
"""Reads the occupancy map that the event at an offset is."""

_OBJECT_LISTS: Final = {
    "sightings": "seen",
    "moves": "moved",
    "estimates": "estimated",
    "classes": "classified",
    "misses": "missing",
    "relocations": "relocated",
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

    def seen_from_all(
        self, places: Iterable[d.PlaceOrdinal], end: Offset
    ) -> Sequence[d.ObjectOrdinal]:
        """The objects seen from every one of these places by the events below ``end``, as ascending
        ordinals."""
        count, history = bisect_left(self._offsets, end), self._history
        survivors: list[int] = [NO_PLACE] * len(history.places)
        for place, record in enumerate(history.places):
            if record.formed.offset < end:
                survivors[place] = history.survivor_of(d.PlaceOrdinal(place), end)
        keyframes = self._keyframes[:count]
        is_placed = self._placed_at[keyframes] < end
        joined = np.where(is_placed, self._placed_in[keyframes], 0)
        found = np.where(is_placed, np.array([*survivors, NO_PLACE])[joined], NO_PLACE)
        seen = [set(np.unique(self._objects[:count][found == place]).tolist()) for place in places]
        things = (
            {history.object_survivor(d.ObjectOrdinal(each), end) for each in from_one}
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
        self._states: dict[d.ObjectOrdinal, tuple[list[int], list[ObjectRecord]]] = {}

    @cached_property
    def keyframes(self) -> Sequence[d.KeyframeAdded]:
        """The keyframes by ordinal."""
        return Chunks(self.tables.count("keyframe"), partial(self.tables.deltas, "keyframe"))

    @cached_property
    def keyframe_offsets(self) -> Sequence[int]:
        """By keyframe the event that added it."""
        return as_ints(self.tables.integers("keyframe", "offset"))

    @cached_property
    def placed_offsets(self) -> Sequence[int]:
        """By keyframe the event that placed it, `NEVER` for noise."""
        return as_ints(placed_columns(self.tables)[0])

    @cached_property
    def placed_in(self) -> Sequence[d.PlaceOrdinal]:
        """By keyframe the place that it joined."""
        return cast("Sequence[d.PlaceOrdinal]", as_ints(placed_columns(self.tables)[1]))

    @cached_property
    def places(self) -> Sequence[history_records.PlaceHistory]:
        """What happened to each place."""
        tables = self.tables
        places = []
        for formed, cause in self._with_causes("formed"):
            place = history_records.PlaceHistory(formed, cause)
            place.joined = _items_of(tables, "placed", "place", formed.place)
            place.changes = _items_of(tables, "changed", "place", formed.place)
            place.names = _items_of(tables, "named", "place", formed.place)
            places.append(place)
        for merge in self.merges:
            places[merge.survivor].merges.append(merge)
            for absorbed in merge.absorbed:
                places[absorbed].absorbed_by = merge
        return places

    @cached_property
    def objects(self) -> Sequence[history_records.ObjectHistory]:
        """What happened to each object."""
        objects = []
        for found, cause in self._with_causes("found"):
            record = history_records.ObjectHistory(found, cause)
            for name, table in _OBJECT_LISTS.items():
                setattr(record, name, _items_of(self.tables, table, "object", found.object))
            objects.append(record)
        for merge in self.object_merges:
            objects[merge.survivor].merges.append(merge)
            objects[merge.absorbed].absorbed_by = merge
        return objects

    @cached_property
    def runs(self) -> Sequence[Sequence[d.RunSeen]]:
        """Each run as it was seen."""
        runs: list[list[d.RunSeen]] = []
        for seen in self.tables.deltas("run"):
            if seen.run == len(runs):
                runs.append([])
            runs[seen.run].append(seen)
        return runs

    @cached_property
    def skipped(self) -> Sequence[d.EventSkipped]:
        """What was left out."""
        return Chunks(self.tables.count("skipped"), partial(self.tables.deltas, "skipped"))

    @cached_property
    def maps(self) -> Sequence[d.MapGiven]:
        """The occupancy maps."""
        if not (count := self.tables.count("map")):
            return []
        offsets = self.tables.column("map", "offset").tolist()
        return [
            d.MapGiven(offset, self.map_at(offset))
            if document is None
            else d.MapGiven(offset, decode_map(document.encode()), scanned=True)
            for offset, document in zip(
                offsets, self.tables.texts("map", "document", 0, count), strict=True
            )
        ]

    @cached_property
    def edges(self) -> Mapping[tuple[d.PlaceOrdinal, d.PlaceOrdinal], Sequence[d.PlacesLinked]]:
        """By pair of places their shared transitions in order."""
        edges: dict[tuple[d.PlaceOrdinal, d.PlaceOrdinal], list[d.PlacesLinked]] = {}
        for linked in self.tables.deltas("linked"):
            edges.setdefault((linked.a, linked.b), []).append(linked)
        return edges

    @cached_property
    def keyframe_ordinals(self) -> Mapping[tuple[RunId, KeyframeId], d.KeyframeOrdinal]:
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
    def merges(self) -> Sequence[history_records.Merge]:
        """The merges of places."""
        texts = self.tables.texts("merge", "document", 0, self.tables.count("merge"))
        decode = msgspec.json.Decoder(history_records.Merge).decode
        return [decode(text or "") for text in texts]

    @cached_property
    def refusals(self) -> Sequence[history_records.RefusedMerge]:
        """The merges that commands refused."""
        return [
            history_records.RefusedMerge(cause, each.a, each.b, each.bridge, each.link, each.apart)
            for each, cause in self._with_causes("refused")
        ]

    @cached_property
    def object_merges(self) -> Sequence[history_records.ObjectMerge]:
        """The merges of objects."""
        return [
            history_records.ObjectMerge(cause, fused) for fused, cause in self._with_causes("fused")
        ]

    @cached_property
    def place_ordinals(self) -> Mapping[str, d.PlaceOrdinal]:
        """The places by id."""
        texts = self.tables.texts("formed", "place_id", 0, self.tables.count("formed"))
        return {text or "": d.PlaceOrdinal(number) for number, text in enumerate(texts)}

    @cached_property
    def object_ordinals(self) -> Mapping[str, d.ObjectOrdinal]:
        """The objects by id."""
        texts = self.tables.texts("found", "object_id", 0, self.tables.count("found"))
        return {text or "": d.ObjectOrdinal(number) for number, text in enumerate(texts)}

    @cached_property
    def neighbours(self) -> Neighbours:
        """The index of keyframes within ε of each other."""
        return Neighbours(posed(self.tables), self.settings)

    def keyframe_count(self, end: Offset) -> int:
        """Keyframes added by the events below ``end``."""
        return self.tables.before("keyframe", end)

    def posed_offsets(self) -> Sequence[int]:
        """The events that added keyframes with a pose, in order."""
        posed = self.tables.column("keyframe", "pose").astype(np.bool_)
        return as_ints(self.tables.integers("keyframe", "offset")[posed])

    def offsets_by_run(self) -> Mapping[str, Sequence[int]]:
        """By run the events that added its keyframes, in order."""
        offsets = self.tables.integers("keyframe", "offset")
        by_run = Groups(self.tables.column("keyframe", "run"), offsets)
        found = {seen[0].run_id: by_run[number] for number, seen in enumerate(self.runs)}
        return {run_id: as_ints(of) for run_id, of in found.items() if len(of)}

    def _with_causes(self, table: str) -> Iterator[tuple[Any, history_records.Cause]]:
        """The deltas of a table, each with its event."""
        found = self.tables.deltas(table)
        return zip(found, self.causes_at([each.offset for each in found]), strict=True)

    def cause_at(self, offset: Offset) -> history_records.Cause:
        """The event at ``offset`` as a cause."""
        (cause,) = self.causes_at([offset])
        return cause

    def causes_at(self, offsets: Sequence[Offset]) -> list[history_records.Cause]:
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
                causes.append(
                    history_records.Cause(offset, "keyframe", time_s, run_id, keyframe_id)
                )
            else:
                causes.append(history_records.Cause(offset, "command"))
        return causes

    @cached_property
    def sighting_index(self) -> SightingIndex:
        """The index of sightings."""
        return SightingIndex(self)

    def place_at(
        self, keyframe: d.KeyframeOrdinal, end: Offset | None = None
    ) -> d.PlaceOrdinal | None:
        """The place a keyframe is in after the events below ``end`` (default: all so far)."""
        end = self.next_offset if end is None else end
        if self.placed_offsets[keyframe] >= end:
            return None
        return self.survivor_of(self.placed_in[keyframe], end)

    def survivor_of(self, place: d.PlaceOrdinal, end: Offset | None = None) -> d.PlaceOrdinal:
        """The place that ``place`` is part of after the events below ``end`` (default: all)."""
        end = self.next_offset if end is None else end
        while (merge := self.places[place].absorbed_by) is not None and merge.cause.offset < end:
            place = merge.survivor
        return place

    def object_survivor(self, found: d.ObjectOrdinal, end: Offset) -> d.ObjectOrdinal:
        """The object that ``found`` is part of after the events below ``end``."""
        while (merge := self.objects[found].absorbed_by) is not None and merge.offset < end:
            found = merge.survivor
        return found

    def object_at(self, found: d.ObjectOrdinal, end: Offset) -> ObjectRecord:
        """What an object is after the events below ``end``, without its observations; not seen
        before it is found."""
        if found not in self._states:
            states = ObjectStates.of_one(self.tables, found)
            while len(self._states) >= _MOST_STATES:
                del self._states[next(iter(self._states))]
            self._states[found] = states.ends.tolist(), states.records(ObjectRecord)
        ends, records = self._states[found]
        row = bisect_right(ends, end) - 1
        first = records[0]
        return records[row] if row >= 0 else ObjectRecord(found, first.object_id, first.class_name)

    def objects_at(self, end: Offset) -> list[ObjectRecord]:
        """`object_at` of all objects found by the events below ``end``, absorbed ones too."""
        return ObjectStates.all_at(self.tables, end).records(ObjectRecord)

    def transitions(self, a: d.PlaceOrdinal, b: d.PlaceOrdinal, end: Offset) -> int:
        """Shared transitions of two places after the events below ``end``."""
        pair = (min(a, b), max(a, b))
        linked = history_records.last_before(self.edges.get(pair, ()), end)
        return 0 if linked is None else linked.shared_transitions


def as_ints(array: Array) -> memoryview:
    """A sequence of Python integers."""
    found: Any = array
    return memoryview(found)


def placed_columns(tables: Tables, end: Offset | None = None) -> tuple[Array, Array]:
    """For each keyframe the event below ``end`` that placed it, and the place that it joined."""
    keyframes = tables.count("keyframe") if end is None else tables.before("keyframe", end)
    count = None if end is None else tables.before("placed", end)
    offsets = np.full(keyframes, NEVER, np.int64)
    places = np.full(keyframes, NO_PLACE, np.int64)
    placed = tables.column("placed", "keyframe", count)
    offsets[placed] = tables.column("placed", "offset", count)
    places[placed] = tables.column("placed", "place", count)
    return offsets, places


def _items_of(tables: Tables, table: str, column: str, value: int) -> list[Any]:
    """The rows of a table whose ``column`` has this value, as deltas in order."""
    rows = tables.group(table, column)[value]
    if not len(rows):
        return []
    found: Items[Any] = Items(
        rows,
        partial(tables.deltas_at, table),
        lambda of: tables.integers(table, "offset")[of],
    )
    return cast("list[Any]", found)
