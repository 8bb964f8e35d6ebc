"""A history read from tables, whose records are made on first access."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from itertools import starmap
from typing import Any, Final, TypeVar, cast

import msgspec
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
    Pose,
    RunSeen,
)
from projections.fold.settings import Settings

from .columns import NONE, Array
from .history import NEVER, NO_PLACE, History
from .lazy_rows import Chunks, Items, OrdinalsByName
from .neighbours import Neighbours, Posed
from .records import Cause, Merge, ObjectHistory, ObjectMerge, PlaceHistory, Refusal
from .tables import Groups, Tables

_T = TypeVar("_T")
MapAt = Callable[[Offset], OccupancyMap]
"""Reads the occupancy map that the event at an offset is."""


class StoredHistory(History):
    """The history of the events in ``tables``; read-only.

    Each attribute is made from the tables when it is first read; `_PARTS` says how.
    """

    def __init__(
        self, settings: Settings, corrections: Corrections, tables: Tables, map_at: MapAt
    ) -> None:
        self.settings = settings
        self.corrections = corrections
        self.next_offset = tables.end
        self.tables = tables
        self.map_at = map_at

    def __getattr__(self, name: str) -> Any:
        if name not in _PARTS:
            raise AttributeError(name)
        found = _PARTS[name](self)
        setattr(self, name, found)
        return found

    @cached_property
    def neighbours(self) -> Neighbours:
        """The index of keyframes within ε of each other."""
        return Neighbours(_posed(self.tables), self.settings)

    def keyframe_count(self, end: Offset) -> int:
        """Keyframes added by the events below ``end``."""
        return self.tables.before("keyframe", end)

    def posed_offsets(self) -> Sequence[int]:
        """The events that added keyframes with a pose, in order."""
        posed = self.tables.column("keyframe", "posed").astype(np.bool_)
        return _as_ints(self.tables.integers("keyframe", "offset")[posed])

    def offsets_by_run(self) -> Mapping[str, Sequence[int]]:
        """By run the events that added its keyframes, in order."""
        offsets = self.tables.integers("keyframe", "offset")
        by_run = Groups(self.tables.column("keyframe", "run"), offsets)
        found = {seen[0].run_id: by_run[number] for number, seen in enumerate(self.runs)}
        return {run_id: _as_ints(of) for run_id, of in found.items() if len(of)}

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


def keyframes_of(tables: Tables, first: int, last: int) -> list[KeyframeAdded]:
    """The keyframes with these ordinals."""
    rows = enumerate(tables.rows("keyframe", first, last), first)
    return [
        KeyframeAdded(
            Offset(offset),
            KeyframeOrdinal(number),
            run,
            run_id,
            keyframe_id,
            timestamp,
            Pose(x_um, y_um, yaw) if posed else None,
            floor,
        )
        for number, (offset, run, run_id, keyframe_id, timestamp, posed, x_um, y_um, yaw, floor)
        in rows
    ]  # fmt: skip


def _posed(tables: Tables) -> Posed:
    """The keyframes that have a pose."""
    numbers = np.flatnonzero(tables.column("keyframe", "posed"))
    x, y = (tables.integers("keyframe", each)[numbers] for each in ("x_um", "y_um"))
    codes, strings = tables.codes("keyframe", "floor")
    names: dict[str | None, int] = {}
    unique, first, inverse = np.unique(codes[numbers], return_index=True, return_inverse=True)
    number_of = np.zeros(len(unique), np.int64)
    for place in np.argsort(first).tolist():
        name = None if unique[place] == NONE else strings[unique[place]]
        number_of[place] = names.setdefault(name, len(names))
    offsets = tables.integers("keyframe", "offset")[numbers]
    return Posed(numbers, offsets, np.stack([x, y], axis=1), number_of[inverse])


def _keyframes(history: StoredHistory) -> Chunks[KeyframeAdded]:
    tables = history.tables
    return Chunks(tables.count("keyframe"), partial(keyframes_of, tables))


def _keyframe_offsets(history: StoredHistory) -> memoryview:
    return _as_ints(history.tables.integers("keyframe", "offset"))


def _as_ints(array: Array) -> memoryview:
    """A sequence of Python integers."""
    found: Any = array
    return memoryview(found)


def _placed_offsets(history: StoredHistory) -> memoryview:
    return _as_ints(placed_columns(history.tables)[0])


def _placed_in(history: StoredHistory) -> memoryview:
    return _as_ints(placed_columns(history.tables)[1])


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


def _places(history: StoredHistory) -> list[PlaceHistory]:
    tables = history.tables
    places = []
    rows = tables.rows("formed", 0, tables.count("formed"))
    causes = history.causes_at([row[0] for row in rows])
    for number, (row, cause) in enumerate(zip(rows, causes, strict=True)):
        place = PlaceHistory(PlaceFormed(row[0], PlaceOrdinal(number), *row[1:]), cause)
        place.joined = _items(tables, "placed", "place", KeyframePlaced, number)
        place.changes = _items(tables, "changed", "place", PlaceChanged, number)
        place.names = _items(tables, "named", "place", PlaceNamed, number)
        places.append(place)
    for merge in history.merges:
        places[merge.survivor].merges.append(merge)
        for absorbed in merge.absorbed:
            places[absorbed].absorbed_by = merge
    return places


_OBJECT_LISTS: Final = {
    "sightings": ("seen", ObjectSeen),
    "moves": ("moved", ObjectMoved),
    "estimates": ("estimated", ObjectEstimated),
    "classes": ("classified", ObjectClassified),
    "misses": ("missing", ObjectMissing),
    "relocations": ("relocated", ObjectRelocated),
}


def _objects(history: StoredHistory) -> list[ObjectHistory]:
    tables = history.tables
    objects = []
    rows = tables.rows("found", 0, tables.count("found"))
    causes = history.causes_at([row[0] for row in rows])
    for number, (row, cause) in enumerate(zip(rows, causes, strict=True)):
        record = ObjectHistory(ObjectFound(row[0], ObjectOrdinal(number), *row[1:]), cause)
        for name, (table, delta) in _OBJECT_LISTS.items():
            setattr(record, name, _items(tables, table, "object", delta, number))
        objects.append(record)
    for merge in history.object_merges:
        objects[merge.survivor].merges.append(merge)
        objects[merge.absorbed].absorbed_by = merge
    return objects


def _items(
    tables: Tables, table: str, column: str, delta: Callable[..., _T], value: int
) -> list[_T]:
    """The rows of a table whose ``column`` has this value, as deltas in order."""
    if not tables.count(table):
        return []
    rows = tables.group(table, column)[value]
    if not len(rows):
        return []
    found = Items(
        rows,
        lambda of: list(starmap(delta, tables.rows_at(table, of))),
        lambda of: tables.integers(table, "offset")[of],
    )
    return cast("list[_T]", found)


def documents(tables: Tables, table: str, type_: type[_T], count: int | None = None) -> list[_T]:
    """The records of a table that stores them as JSON."""
    texts = tables.texts(table, "document", 0, tables.count(table) if count is None else count)
    decode = msgspec.json.Decoder(type_).decode
    return [decode(text or "") for text in texts]


def _runs(history: StoredHistory) -> list[list[RunSeen]]:
    tables = history.tables
    runs: list[list[RunSeen]] = []
    for seen in starmap(RunSeen, tables.rows("run", 0, tables.count("run"))):
        if seen.run == len(runs):
            runs.append([])
        runs[seen.run].append(seen)
    return runs


def _skipped(history: StoredHistory) -> Chunks[EventSkipped]:
    tables = history.tables
    return Chunks(
        tables.count("skipped"),
        lambda a, b: list(starmap(EventSkipped, tables.rows("skipped", a, b))),
    )


def _maps(history: StoredHistory) -> list[MapGiven]:
    offsets = history.tables.column("map", "offset").tolist() if history.tables.count("map") else []
    return [MapGiven(Offset(offset), history.map_at(Offset(offset))) for offset in offsets]


def _edges(history: StoredHistory) -> dict[tuple[PlaceOrdinal, PlaceOrdinal], list[PlacesLinked]]:
    tables = history.tables
    edges: dict[tuple[PlaceOrdinal, PlaceOrdinal], list[PlacesLinked]] = {}
    for linked in starmap(PlacesLinked, tables.rows("linked", 0, tables.count("linked"))):
        edges.setdefault((linked.a, linked.b), []).append(linked)
    return edges


def _keyframe_ordinals(history: StoredHistory) -> OrdinalsByName:
    tables = history.tables
    runs = {seen[0].run_id: number for number, seen in enumerate(history.runs)}

    def find(name: tuple[RunId, KeyframeId]) -> int | None:
        run_id, keyframe_id = name
        if run_id not in runs:
            return None
        same = tables.column("keyframe", "keyframe_id") == keyframe_id
        found = np.flatnonzero(same & (tables.column("keyframe", "run") == runs[run_id]))
        return int(found[-1]) if len(found) else None

    def names() -> Iterator[tuple[RunId, KeyframeId]]:
        return ((k.run_id, k.keyframe_id) for k in history.keyframes)

    return OrdinalsByName(tables.count("keyframe"), find, names)


def _ordinals(table: str, column: str, history: StoredHistory) -> dict[str | None, int]:
    texts = history.tables.texts(table, column, 0, history.tables.count(table))
    return {text: number for number, text in enumerate(texts)}


_PARTS: Final[dict[str, Callable[[StoredHistory], Any]]] = {
    "keyframes": _keyframes,
    "keyframe_offsets": _keyframe_offsets,
    "placed_offsets": _placed_offsets,
    "placed_in": _placed_in,
    "places": _places,
    "objects": _objects,
    "merges": lambda history: documents(history.tables, "merge", Merge),
    "refusals": lambda history: documents(history.tables, "refusal", Refusal),
    "object_merges": lambda history: documents(history.tables, "object_merge", ObjectMerge),
    "runs": _runs,
    "skipped": _skipped,
    "maps": _maps,
    "edges": _edges,
    "keyframe_ordinals": _keyframe_ordinals,
    "place_ordinals": partial(_ordinals, "formed", "place_id"),
    "object_ordinals": partial(_ordinals, "found", "object_id"),
}
