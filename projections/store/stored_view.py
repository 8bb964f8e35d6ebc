"""The map at any offset, made from the columns of a history without folding.

Counts, places and objects are computed from whole columns. Keyframes and observations, the members
of a place and the observations of an Object, most of the data, are made on first access, and all
before the view is changed.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise, repeat
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import Offset
from projections.fold import deltas as d
from projections.fold.pair_groups import PlaceSurvivors
from projections.map.records import (
    KeyframeRecord,
    ObjectRecord,
    ObservationRecord,
    PlaceRecord,
    Poses,
    Relocation,
    RunRecord,
)
from projections.map.view import MapView

from .columns import NO_INT, NONE, TABLES
from .history import History
from .history_records import Chunks
from .moment import Moment
from .object_states import ObjectStates
from .timeline_cache import TimelineCache


class StoredView(MapView):
    """The map after ``end`` events of a history of tables; the caller may change it.

    Its digest is kept in ``cache``, if there is one. Its `vectors` are those that ``recorded``
    gives; its observations have no embeddings.
    """

    def __init__(
        self,
        history: History,
        end: Offset,
        cache: TimelineCache | None = None,
        recorded: Callable[[NDArray[np.int64]], NDArray[np.int32]] | None = None,
    ) -> None:
        super().__init__(
            history.settings,
            keep_embeddings=recorded is not None,
            corrections=history.corrections,
        )
        self._is_changed = False
        self._cache, self._recorded = cache, recorded
        self._moment = moment = Moment(history, end)
        self.all_places = _places(moment)
        for merge in moment.merges:
            self.survivors.merge(merge.survivor, merge.absorbed)
        gone = self.survivors.absorbed_by
        self.places = {p.ordinal: p for p in self.all_places if p.ordinal not in gone}
        self.all_objects = _objects(moment)
        for survivor, absorbed in moment.object_merges:
            self.object_survivors.merge(survivor, (absorbed,))
        fused = self.object_survivors.absorbed_by
        self.objects = {o.ordinal: o for o in self.all_objects if o.ordinal not in fused}
        for found in self.objects.values():
            self.contents.update(found)
        self.runs = _runs(moment)
        self.adjacency = _adjacency(moment)
        for kind, count in _skipped(moment).items():
            self.skipped[cast("d.SkipKind", kind)] = count
        self.floors = {name: number for number, name in enumerate(_floors(moment))}
        if joined := moment.count("joined"):
            of_frames: list[d.FrameJoined] = moment.tables.deltas("joined", 0, joined)
            self.frames = {each.frame: each for each in of_frames}
        for given in history.maps[: moment.count("map")] if moment.count("map") else ():
            self.maps[given.map.floor] = given
        self.has_bodies = bool(moment.column("observation", "body").any())
        keyframes: Chunks[KeyframeRecord] = Chunks(
            moment.count("keyframe"), partial(_keyframes, moment, self.survivors)
        )
        observations: Chunks[ObservationRecord] = Chunks(
            moment.count("observation"), partial(_observations, moment)
        )
        self.keyframes = cast("list[KeyframeRecord]", keyframes)
        self.observations = cast("list[ObservationRecord]", observations)
        self.advance(end)

    def apply(self, delta: d.Delta) -> None:
        """Apply one delta."""
        self._make_all()
        super().apply(delta)

    def apply_event(self, offset: Offset, deltas: Iterable[d.Delta]) -> None:
        """Apply all deltas of the event at ``offset`` and advance past it."""
        self._make_all()
        super().apply_event(offset, deltas)

    def known_digest(self) -> str | None:
        """The digest of this map from the cache; None if it was not computed before."""
        if self._cache is None or self._is_changed:
            return None
        return self._cache.digest_at(self.next_offset)

    def keep_digest(self, digest: str) -> None:
        """Store the digest in the cache."""
        if self._cache is not None and not self._is_changed:
            self._cache.keep_digest(self.next_offset, digest)

    def seen_by(self, found: ObjectRecord) -> list[d.KeyframeOrdinal]:
        """The ordinals of `sightings`."""
        if self._is_changed or not found.observations:
            return super().seen_by(found)
        keyframes: list[d.KeyframeOrdinal]
        keyframes = self._moment.column("observation", "keyframe")[found.observations].tolist()
        return keyframes

    def poses(self) -> Poses:
        """The keyframes that have a pose, in the order in which their runs went."""
        if self._is_changed:
            return super().poses()
        moment, count = self._moment, self._moment.count("keyframe")
        numbers = np.flatnonzero(moment.column("keyframe", "pose"))
        for name in ("keyframe_id", "run"):
            numbers = numbers[np.argsort(moment.column("keyframe", name)[numbers], kind="stable")]
        runs, x, y = (
            moment.tables.integers("keyframe", each, count)[numbers]
            for each in ("run", "x_um", "y_um")
        )
        codes, strings = moment.tables.codes("keyframe", "floor", count)
        names: dict[str | None, int] = {}
        number_of = [names.setdefault(name, len(names)) for name in (*strings, None)]
        floors = np.array(number_of)[codes[numbers]]  # no name is -1, the last
        return Poses(numbers, runs, np.stack([x, y], axis=1), floors, list(names))

    def det_ids(self) -> Sequence[str]:
        """The det_id of each observation."""
        if self._is_changed:
            return super().det_ids()
        count = self._moment.count("observation")
        return [each or "" for each in self._moment.tables.texts("observation", "det_id", 0, count)]

    def embedded(self) -> NDArray[np.int64]:
        """The observations that have a vector of the map's space."""
        if self._recorded is None or self._is_changed:
            return super().embedded()
        return np.flatnonzero(self._moment.column("observation", "crc") != NONE)

    def vectors(self, observations: NDArray[np.int64]) -> NDArray[np.int32]:
        """The unit vectors of some of `embedded`. Raises LogError, FoldError."""
        if self._recorded is None:
            return super().vectors(observations)
        return self._recorded(observations)

    def floor_of(self, place: d.PlaceOrdinal) -> str | None:
        """The name of the floor that a place is on; None if the log has none."""
        return super().floor_of(place) if self.floors else None

    @property
    def first_floor(self) -> str | None:
        """The floor of the first pose; None also where there is none."""
        return super().first_floor if self.floors else None

    def _sums(self) -> tuple[int, int, int]:
        if self._is_changed:
            return super()._sums()
        moment = self._moment
        return (
            int(np.count_nonzero(moment.column("keyframe", "pose"))),
            int(np.count_nonzero(moment.is_fused)),
            int(np.count_nonzero(moment.column("observation", "foreign_space"))),
        )

    def without_camera(self) -> int:
        """The number of keyframes with observations whose envelopes do not state a camera."""
        if self._is_changed:
            return super().without_camera()
        has_any = np.diff(self._moment.observation_starts) > 0
        return int(np.count_nonzero(has_any & (self._moment.column("keyframe", "camera") == 0)))

    def _make_all(self) -> None:
        """Make every record, so that they can be changed."""
        if not self._is_changed:
            self._is_changed = True
            self.keyframes, self.observations = list(self.keyframes), list(self.observations)


def _keyframes(
    moment: Moment, survivors: PlaceSurvivors, first: int, last: int
) -> list[KeyframeRecord]:
    added: list[d.KeyframeAdded] = moment.tables.deltas("keyframe", first, last)
    _, joined = moment.placed
    starts = moment.observation_starts[first : last + 1].tolist()
    places = joined[first:last].tolist()
    return [
        KeyframeRecord(
            k.keyframe,
            k.offset,
            k.run,
            k.run_id,
            k.keyframe_id,
            k.timestamp,
            k.pose,
            survivors,
            list(map(d.ObservationOrdinal, range(*span))) or (),
            None if place == NONE else place,
            k.floor,
            k.camera,
            k.frame,
        )
        for k, span, place in zip(added, pairwise(starts), places, strict=True)
    ]


def _observations(moment: Moment, first: int, last: int) -> list[ObservationRecord]:
    columns = moment.tables.lists("observation", first, last)
    found = dict(zip(TABLES["observation"], columns, strict=True))
    objects, similarities = (column[first:last].tolist() for column in moment.fused)
    return list(
        map(
            ObservationRecord,
            range(first, last),
            found["keyframe"],
            found["det_id"],
            found["class_name"],
            found["confidence"],
            zip(*(found[f"bbox{number}"] for number in range(4)), strict=True),
            found["embedding_model"],
            repeat(None),
            found["crc"],
            found["foreign_space"],
            [None if each == NONE else each for each in objects],
            [None if q40 == NO_INT else q40 for q40 in similarities],
            found["measured"],
            _bodies(found),
        )
    )


def _bodies(found: dict[str, list[Any]]) -> Iterable[d.Body | None]:
    there, *parts = (found[name] for name in TABLES["observation"] if name.startswith("body"))
    made = (d.Body(*each) for each in zip(*parts, strict=True))
    return (each if is_there else None for each, is_there in zip(made, there, strict=True))


class StoredPlace(PlaceRecord):
    """A place whose members are made on first access."""

    __slots__ = ("_made", "_moment")

    _moment: Moment
    _made: list[d.KeyframeOrdinal] | None

    def read_from(self, moment: Moment) -> None:
        """Use ``moment`` as the source of the members."""
        self._moment, self._made = moment, None

    @property
    def unordered_members(self) -> list[d.KeyframeOrdinal]:
        if self._made is None:
            self._made = self._moment.members[self.ordinal].tolist()
        return self._made

    @unordered_members.setter
    def unordered_members(self, members: list[d.KeyframeOrdinal]) -> None:
        self._made = members


def _places(moment: Moment) -> list[PlaceRecord]:
    formed = moment.deltas("formed")
    changed = moment.last_deltas("changed", "place", len(formed))
    named = moment.last_deltas("named", "place", len(formed))
    places: list[PlaceRecord] = []
    for new, change, name in zip(formed, changed, named, strict=True):
        place = StoredPlace(new.place, new.place_id, new.founder, new.offset)
        place.read_from(moment)
        if change is not None:
            place.keyframe_count = change.keyframe_count
            place.sum_x_um, place.sum_y_um = change.sum_x_um, change.sum_y_um
        if name is not None:
            place.name, place.name_offset = name.name, name.command
        places.append(place)
    return places


class StoredObject(ObjectRecord):
    """An Object whose observations are made on first access."""

    __slots__ = ("_made", "_moment")

    _moment: Moment
    _made: list[d.ObservationOrdinal] | None

    def read_from(self, moment: Moment) -> None:
        """Use ``moment`` as the source of the observations."""
        self._moment, self._made = moment, None

    @property
    def observations(self) -> list[d.ObservationOrdinal]:
        if self._made is None:
            moment, absorbed = self._moment, self.ordinal in self._moment.absorbed_objects
            made = [] if absorbed else moment.sightings[self.ordinal].tolist()
            if self.ordinal in moment.survivors_of_objects:
                made.sort()
            self._made = made  # when it is sorted: another thread may read it
        return self._made

    @observations.setter
    def observations(self, observations: list[d.ObservationOrdinal]) -> None:
        self._made = observations


def _objects(moment: Moment) -> list[ObjectRecord]:
    objects = ObjectStates.all_at(moment.tables, moment.end).records(StoredObject)
    for each in objects:
        each.read_from(moment)
    moved: list[d.ObjectRelocated] = moment.deltas("relocated")
    for way in moved:
        at = (way.from_x_um, way.from_y_um, way.to_x_um, way.to_y_um)
        objects[way.object].relocations.append(Relocation(way.offset, way.observation, *at))
    for survivor, absorbed in moment.object_merges:  # in order
        relocations = objects[survivor].relocations + objects[absorbed].relocations
        objects[survivor].relocations = sorted(relocations, key=lambda r: (r.offset, r.observation))
        objects[absorbed].relocations = []
    return cast("list[ObjectRecord]", objects)


def _runs(moment: Moment) -> list[RunRecord]:
    records: list[RunRecord] = []
    for seen in moment.deltas("run"):
        if seen.run == len(records):
            records.append(RunRecord(seen.run, seen.run_id, seen.started_at))
        records[seen.run].started_at = seen.started_at
    counts = np.bincount(moment.column("keyframe", "run"), minlength=len(records))
    for record, count in zip(records, counts.tolist(), strict=True):
        record.keyframe_count = count
    return records


def _adjacency(moment: Moment) -> dict[tuple[d.PlaceOrdinal, d.PlaceOrdinal], int]:
    a, b = (moment.column("linked", each).astype(np.int64) for each in ("a", "b"))
    pairs = a << 32 | b
    _, first = np.unique(pairs, return_index=True)
    _, last = np.unique(pairs[::-1], return_index=True)  # both in the order of the pairs
    rows = (len(pairs) - 1 - last)[np.argsort(first)]
    counts = moment.column("linked", "shared_transitions")[rows].tolist()
    found = zip(a[rows].tolist(), b[rows].tolist(), counts, strict=True)
    return {(d.PlaceOrdinal(a), d.PlaceOrdinal(b)): count for a, b, count in found if count}


def _floors(moment: Moment) -> list[str]:
    """The named floors in the order of their first keyframes."""
    codes, strings = moment.tables.codes("keyframe", "floor", moment.count("keyframe"))
    named = codes[codes >= 0]
    _, first = np.unique(named, return_index=True)
    return list(dict.fromkeys(strings[code] for code in named[np.sort(first)].tolist()))


def _skipped(moment: Moment) -> dict[str, int]:
    codes, strings = moment.tables.codes("skipped", "kind", moment.count("skipped"))
    kinds, counts = np.unique(codes, return_counts=True)
    found: dict[str, int] = {}
    for code, count in zip(kinds.tolist(), counts.tolist(), strict=True):
        found[strings[code]] = found.get(strings[code], 0) + count
    return found
