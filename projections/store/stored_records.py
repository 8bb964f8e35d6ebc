"""Records of a map as of an offset, made from the columns of a history.

The members of a place and the observations of an Object, most of the data, are made on first
access.
"""

from collections.abc import Sequence
from itertools import starmap
from typing import Any

import numpy as np

from projections.fold.deltas import (
    KeyframeOrdinal,
    ObjectOrdinal,
    ObservationOrdinal,
    PlaceOrdinal,
    RunOrdinal,
    RunSeen,
)
from projections.map.records import Estimate, ObjectRecord, PlaceRecord, Relocation, RunRecord

from .moment import Moment
from .records import ObjectMerge


class StoredPlace(PlaceRecord):
    """A place whose members are made on first access."""

    __slots__ = ("_made", "_moment")

    _moment: Moment
    _made: list[KeyframeOrdinal] | None

    def read_from(self, moment: Moment) -> None:
        """Use ``moment`` as the source of the members."""
        self._moment, self._made = moment, None

    @property
    def unordered_members(self) -> list[KeyframeOrdinal]:
        if self._made is None:
            self._made = self._moment.members[self.ordinal].tolist()
        return self._made

    @unordered_members.setter
    def unordered_members(self, members: list[KeyframeOrdinal]) -> None:
        self._made = members


def places_of(moment: Moment) -> list[PlaceRecord]:
    formed = moment.rows("formed")
    changed = moment.last_values("changed", "place", len(formed))
    named = moment.last_values("named", "place", len(formed))
    places: list[PlaceRecord] = []
    for number, (offset, place_id, founder) in enumerate(formed):
        place = StoredPlace(PlaceOrdinal(number), place_id, founder, offset)
        place.read_from(moment)
        if (change := changed[number]) is not None:
            _, _, place.keyframe_count, place.sum_x_um, place.sum_y_um = change
        if (name := named[number]) is not None:
            _, _, place.name, place.name_offset = name
        places.append(place)
    return places


class StoredObject(ObjectRecord):
    """An Object whose observations are made on first access."""

    __slots__ = ("_made", "_moment")

    _moment: Moment
    _made: list[ObservationOrdinal] | None

    def read_from(self, moment: Moment) -> None:
        """Use ``moment`` as the source of the observations."""
        self._moment, self._made = moment, None

    @property
    def observations(self) -> list[ObservationOrdinal]:
        if self._made is None:
            moment, absorbed = self._moment, self.ordinal in self._moment.absorbed_objects
            made = [] if absorbed else moment.sightings[self.ordinal].tolist()
            if self.ordinal in moment.survivors_of_objects:
                made.sort()
            self._made = made  # when it is sorted: another thread may read it
        return self._made

    @observations.setter
    def observations(self, observations: list[ObservationOrdinal]) -> None:
        self._made = observations


def objects_of(moment: Moment) -> list[ObjectRecord]:
    found = moment.rows("found")
    size = len(found)
    seen, moved, estimated, classified, missing, relocated = (
        moment.last_values(table, "object", size)
        for table in ("seen", "moved", "estimated", "classified", "missing", "relocated")
    )
    objects: list[ObjectRecord] = []
    for number, (_, object_id, class_name, _) in enumerate(found):
        record = StoredObject(ObjectOrdinal(number), object_id, class_name)
        record.read_from(moment)
        if (last := seen[number]) is not None:
            _set_values(record, last[4:])
        if (place := moved[number]) is not None:
            record.place = place[2]
        if (named := classified[number]) is not None:
            record.class_name = named[2]
        if (estimate := estimated[number]) is not None:
            record.estimate = Estimate(*estimate[2:])
        looked, again = missing[number], relocated[number]
        if looked is not None and (again is None or again[0] <= looked[0]):
            record.misses = looked[3]
            record.missing_in = RunOrdinal(looked[2]) if looked[4] else None
        objects.append(record)
    for offset, number, *values in moment.rows("relocated"):
        objects[number].relocations.append(Relocation(offset, *values))
    for merge in moment.object_merges:
        _merge(objects[merge.survivor], objects[merge.absorbed], merge)
    return objects


def _merge(survivor: ObjectRecord, absorbed: ObjectRecord, merge: ObjectMerge) -> None:
    """Apply a merge to the records of two Objects; merges are applied in order."""
    values = merge.values
    relocations = survivor.relocations + absorbed.relocations
    survivor.relocations = sorted(relocations, key=lambda r: (r.offset, r.observation))
    absorbed.relocations = []
    if survivor.obs_count <= values.obs_count:
        taken = (values.obs_count, values.sum_x_um, values.sum_y_um)
        _set_values(survivor, (*taken, values.first_seen, values.last_seen))


def _set_values(record: ObjectRecord, values: Sequence[Any]) -> None:
    record.obs_count, record.sum_x_um, record.sum_y_um = values[:3]
    record.first_seen, record.last_seen = values[3:]


def runs_of(moment: Moment) -> list[RunRecord]:
    records: list[RunRecord] = []
    for seen in starmap(RunSeen, moment.rows("run")):
        if seen.run == len(records):
            records.append(RunRecord(seen.run, seen.run_id, seen.started_at))
        records[seen.run].started_at = seen.started_at
    counts = np.bincount(moment.column("keyframe", "run"), minlength=len(records))
    for record, count in zip(records, counts.tolist(), strict=True):
        record.keyframe_count = count
    return records


def adjacency_of(moment: Moment) -> dict[tuple[PlaceOrdinal, PlaceOrdinal], int]:
    a, b = (moment.column("linked", each).astype(np.int64) for each in ("a", "b"))
    pairs = a << 32 | b
    _, first = np.unique(pairs, return_index=True)
    _, last = np.unique(pairs[::-1], return_index=True)  # both in the order of the pairs
    rows = (len(pairs) - 1 - last)[np.argsort(first)]
    counts = moment.column("linked", "shared_transitions")[rows].tolist()
    found = zip(a[rows].tolist(), b[rows].tolist(), counts, strict=True)
    return {(PlaceOrdinal(a), PlaceOrdinal(b)): count for a, b, count in found if count}


def floors_of(moment: Moment) -> list[str]:
    """The named floors in the order of their first keyframes."""
    codes, strings = moment.tables.codes("keyframe", "floor", moment.count("keyframe"))
    named = codes[codes >= 0]
    _, first = np.unique(named, return_index=True)
    return list(dict.fromkeys(strings[code] for code in named[np.sort(first)].tolist()))


def skipped_of(moment: Moment) -> dict[str, int]:
    codes, strings = moment.tables.codes("skipped", "kind", moment.count("skipped"))
    kinds, counts = np.unique(codes, return_counts=True)
    found: dict[str, int] = {}
    for code, count in zip(kinds.tolist(), counts.tolist(), strict=True):
        found[strings[code]] = found.get(strings[code], 0) + count
    return found
