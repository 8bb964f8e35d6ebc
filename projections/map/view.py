"""The map as data, built from deltas alone.

The same deltas, from wherever, give the same view; applying one twice does no harm. A merge moves
the smaller member list into the larger one and leaves keyframes with the place they joined, whose
survivor `KeyframeRecord.place` looks up: it costs little however many keyframes move.
"""

from bisect import insort
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.machine import crc32
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from projections.fold import deltas
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.deltas import Delta, ObjectOrdinal, PlaceOrdinal, SkipKind
from projections.fold.floors import map_in_force
from projections.fold.pair_groups import ObjectSurvivors, PlaceSurvivors
from projections.fold.place_types import PlaceType, place_type
from projections.fold.settings import Settings

from . import records
from .records import confirm

_T = TypeVar("_T")
_RARELY: tuple[SkipKind, ...] = ("forgotten", "dropped", "scan_too_far")


class MapView:
    """A whole map state. Read its attributes; change it by `apply` and `advance` only.

    ``runs``, ``keyframes`` and ``observations`` are lists indexed by ordinal. ``places`` are those
    not absorbed, by ordinal, ascending; ``all_places`` also has the absorbed ones, whose survivors
    ``survivors`` gives. Likewise ``objects``, ``all_objects`` and ``object_survivors``.
    ``adjacency`` maps (a, b), a founded before b, to shared transitions above 0; `edges` sorts it.
    ``floors`` numbers those that have a name by their first keyframe; ``frames`` are those joined.
    ``maps`` are the last occupancy maps by the floor that they name, each with the offset of its
    event. ``next_offset`` is the number of events in the view, folded under ``corrections``.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        keep_embeddings: bool = True,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> None:
        self.settings = settings
        self.corrections = corrections
        self.keep_embeddings = keep_embeddings
        self.next_offset = FIRST_OFFSET
        self.runs: list[records.RunRecord] = []
        self.keyframes: list[records.KeyframeRecord] = []
        self.observations: list[records.ObservationRecord] = []
        self.has_bodies = False  # whether any observation has one
        self.all_objects: list[records.ObjectRecord] = []
        self.objects: dict[ObjectOrdinal, records.ObjectRecord] = {}
        self.object_survivors = ObjectSurvivors()
        self.all_places: list[records.PlaceRecord] = []
        self.places: dict[PlaceOrdinal, records.PlaceRecord] = {}
        self.survivors = PlaceSurvivors()
        self.adjacency: dict[tuple[PlaceOrdinal, PlaceOrdinal], int] = {}
        self.floors: dict[str, int] = {}
        self.frames: dict[str, deltas.FrameJoined] = {}
        self.contents = records.PlaceContents()
        self.maps: dict[str | None, deltas.MapGiven] = {}
        self.skipped: dict[SkipKind, int] = {"duplicate": 0, "conflict": 0, "det_id_reused": 0}
        self._made: dict[Callable[..., Any], Any] = {}

    def once(self, make: Callable[["MapView"], _T]) -> _T:
        """What ``make`` makes of this map, kept until a delta changes it; it must not hold it."""
        if make not in self._made:
            self._made[make] = make(self)
        found: _T = self._made[make]
        return found

    def apply(self, delta: Delta) -> None:
        """Apply one delta."""
        self._made = {}
        self._APPLIERS[type(delta)](self, delta)

    def apply_event(self, offset: Offset, changes: Iterable[Delta]) -> None:
        """Apply all deltas of the event at ``offset`` and advance past it."""
        self._made = {}
        appliers = self._APPLIERS
        for delta in changes:
            appliers[type(delta)](self, delta)
        self.next_offset = Offset(offset + 1)

    def advance(self, next_offset: Offset) -> None:
        """Set ``next_offset``."""
        self.next_offset = next_offset

    def known_digest(self) -> str | None:
        """The digest of this map, where it was kept."""

    def keep_digest(self, digest: str) -> None:
        """Keep the digest, if the view has a cache for it."""

    def place_id(self, place: PlaceOrdinal | None) -> str | None:
        """The id of a place, absorbed ones too; None for None."""
        return None if place is None else self.all_places[place].place_id

    def floor_of(self, place: PlaceOrdinal) -> str | None:
        """The name of the floor that a place is on; None if the log has none."""
        return self.keyframes[self.all_places[place].founder].floor

    @property
    def first_floor(self) -> str | None:
        """The floor of the first pose; None also where there is none."""
        return next((k.floor for k in self.keyframes if k.pose is not None), None)

    @property
    def map(self) -> deltas.MapGiven | None:
        """The occupancy map in force on the first floor."""
        return map_in_force(self.maps, self.first_floor, is_first=True) if self.maps else None

    def maps_in_force(self) -> dict[str | None, deltas.MapGiven]:
        """The occupancy map of each floor that has one, ordered by offset."""
        found = dict(self.maps)
        if None in self.maps:
            found = {self.first_floor: found.pop(None)} | found
        return dict(sorted(found.items(), key=lambda item: item[1].offset))

    def is_between_floors(self, a: PlaceOrdinal, b: PlaceOrdinal) -> bool:
        """Whether two places are on two floors, so that a way between them is stairs or a lift."""
        return bool(self.floors) and self.floor_of(a) != self.floor_of(b)

    def type_of(self, place: PlaceOrdinal) -> PlaceType | None:
        """The type of room that a place is, by its Objects or its name; None if unknown."""
        return place_type(self.contents.of(place), self.all_places[place].name)

    def body_of(self, found: records.ObjectRecord) -> deltas.Body | None:
        """The height and size of an Object by its observations; None where none has any."""
        return records.measured_body(found, self.observations) if self.has_bodies else None

    def det_ids(self) -> Sequence[str]:
        """The det_id of each observation."""
        return [each.det_id for each in self.observations]

    def class_counts(self, found: records.ObjectRecord) -> dict[str, int]:
        """The number of an Object's observations by class, most first; ties by name."""
        names = (self.observations[number].class_name for number in found.observations)
        return dict(sorted(Counter(names).items(), key=lambda item: (-item[1], item[0])))

    def sightings(self, found: records.ObjectRecord) -> list[records.KeyframeRecord]:
        """The keyframes that saw an Object, one for each observation, in their order."""
        return [self.keyframes[number] for number in self.seen_by(found)]

    def seen_by(self, found: records.ObjectRecord) -> list[deltas.KeyframeOrdinal]:
        """The ordinals of `sightings`."""
        return [self.observations[number].keyframe for number in found.observations]

    def poses(self) -> records.Poses:
        """The keyframes that have a pose, in the order in which their runs went."""
        return records.Poses.of(self.keyframes)

    def edges(self) -> list[tuple[PlaceOrdinal, PlaceOrdinal, int]]:
        """(a, b, shared_transitions), ascending."""
        return [(a, b, n) for (a, b), n in sorted(self.adjacency.items())]

    def _run_seen(self, delta: deltas.RunSeen) -> None:
        if delta.run == len(self.runs):
            self.runs.append(records.RunRecord(delta.run, delta.run_id, delta.started_at))
        self.runs[delta.run].started_at = delta.started_at

    def _keyframe_added(self, delta: deltas.KeyframeAdded) -> None:
        if delta.keyframe < len(self.keyframes):
            return
        self.runs[delta.run].keyframe_count += 1
        known = delta.keyframe, delta.offset, delta.run, delta.run_id, delta.keyframe_id
        seen = delta.timestamp, delta.pose, self.survivors
        record = records.KeyframeRecord
        self.keyframes.append(
            record(*known, *seen, (), None, delta.floor, delta.camera, delta.frame)
        )
        if delta.floor is not None:
            self.floors.setdefault(delta.floor, len(self.floors))

    def _observation_added(self, delta: deltas.ObservationAdded) -> None:
        if delta.observation < len(self.observations):
            return
        keyframe = self.keyframes[delta.keyframe]
        if isinstance(keyframe.observations, tuple):
            keyframe.observations = []
        keyframe.observations.append(delta.observation)
        vector = delta.embedding
        self.observations.append(
            records.ObservationRecord(
                delta.observation,
                delta.keyframe,
                delta.det_id,
                delta.class_name,
                delta.confidence,
                delta.bbox,
                delta.embedding_model,
                vector if self.keep_embeddings else None,
                None if vector is None else crc32(vector.data),
                delta.foreign_space,
                measured=delta.measured,
                body=delta.body,
            )
        )
        self.has_bodies = self.has_bodies or delta.body is not None

    def _event_skipped(self, delta: deltas.EventSkipped) -> None:
        if delta.offset >= self.next_offset:
            self.skipped[delta.kind] = self.skipped.get(delta.kind, 0) + 1

    def _place_formed(self, delta: deltas.PlaceFormed) -> None:
        if delta.place < len(self.all_places):
            return
        place = records.PlaceRecord(delta.place, delta.place_id, delta.founder, delta.offset)
        self.all_places.append(place)
        self.places[delta.place] = place

    def _places_merged(self, delta: deltas.PlacesMerged) -> None:
        survivor = self.all_places[delta.survivor]
        for ordinal in delta.absorbed:
            absorbed = self.places.pop(ordinal, None)
            if absorbed is None:
                continue
            both = absorbed.unordered_members, survivor.unordered_members
            small, large = sorted(both, key=len)
            large.extend(small)
            survivor.unordered_members = large
            absorbed.unordered_members = []
            self.survivors.merge(delta.survivor, (ordinal,))

    def _keyframe_placed(self, delta: deltas.KeyframePlaced) -> None:
        keyframe = self.keyframes[delta.keyframe]
        if keyframe.joined is None:
            keyframe.joined = delta.place
            self.all_places[delta.place].unordered_members.append(delta.keyframe)

    def _place_changed(self, delta: deltas.PlaceChanged) -> None:
        place = self.all_places[delta.place]
        place.keyframe_count = delta.keyframe_count
        place.sum_x_um, place.sum_y_um = delta.sum_x_um, delta.sum_y_um

    def _place_named(self, delta: deltas.PlaceNamed) -> None:
        place = self.all_places[delta.place]
        place.name, place.name_offset = delta.name, delta.command

    def _object_found(self, delta: deltas.ObjectFound) -> None:
        if delta.object == len(self.all_objects):
            found = records.ObjectRecord(delta.object, delta.object_id, delta.class_name)
            self.all_objects.append(found)
            self.objects[delta.object] = found

    def _object_seen(self, delta: deltas.ObjectSeen) -> None:
        found = self.all_objects[delta.object]
        observation = self.observations[delta.observation]
        if observation.object is None:
            observation.object = delta.object
            observation.similarity_q40 = delta.similarity_q40
            found.observations.append(delta.observation)
            confirm(found, (delta.observation,), self.observations, self.keyframes)
        is_counted = (found.obs_count > 1) is (delta.obs_count > 1)
        found.recount(delta)
        if not is_counted:
            self.contents.update(found)

    def _objects_merged(self, delta: deltas.ObjectsMerged) -> None:
        survivor = self.all_objects[delta.survivor]
        absorbed = self.objects.pop(delta.absorbed, None)
        if absorbed is not None:
            for observation in (moved := tuple(absorbed.observations)):
                self.observations[observation].object = delta.survivor
            small, large = sorted((absorbed.observations, survivor.observations), key=len)
            for observation in small:  # to sort all takes long where an Object absorbs many
                insort(large, observation)
            survivor.observations = large
            survivor.confirmed |= absorbed.confirmed
            confirm(survivor, moved, self.observations, self.keyframes)
            relocations = survivor.relocations + absorbed.relocations
            survivor.relocations = sorted(relocations, key=lambda r: (r.offset, r.observation))
            absorbed.observations, absorbed.relocations, absorbed.place = [], [], None
            self.contents.update(absorbed)
            self.object_survivors.merge(delta.survivor, (delta.absorbed,))
        survivor.recount(delta)
        self.contents.update(survivor)

    def _object_estimated(self, delta: deltas.ObjectEstimated) -> None:
        variances = delta.var_xx_um2, delta.var_xy_um2, delta.var_yy_um2
        at = records.EstimatedPosition(delta.x_um, delta.y_um, *variances, delta.spots)
        self.all_objects[delta.object].estimate = at

    def _object_classified(self, delta: deltas.ObjectClassified) -> None:
        found = self.all_objects[delta.object]
        found.class_name = delta.class_name
        self.contents.update(found)

    def _object_missing(self, delta: deltas.ObjectMissing) -> None:
        found = self.all_objects[delta.object]
        found.misses, found.missing_in = delta.misses, delta.run if delta.missing else None

    def _object_relocated(self, delta: deltas.ObjectRelocated) -> None:
        found = self.all_objects[delta.object]
        found.misses, found.missing_in = 0, None
        at = (delta.from_x_um, delta.from_y_um, delta.to_x_um, delta.to_y_um)
        moved = records.Relocation(delta.offset, delta.observation, *at)
        if moved not in found.relocations:
            found.relocations.append(moved)

    def _object_moved(self, delta: deltas.ObjectMoved) -> None:
        found = self.all_objects[delta.object]
        found.place = delta.place
        self.contents.update(found)

    def _places_linked(self, delta: deltas.PlacesLinked) -> None:
        if delta.shared_transitions:
            self.adjacency[delta.a, delta.b] = delta.shared_transitions
        else:
            self.adjacency.pop((delta.a, delta.b), None)

    def _map_given(self, delta: deltas.MapGiven) -> None:
        self.maps[delta.map.floor] = delta

    # Functions of the class, not bound methods: a view that refers to itself would stay in memory,
    # once it is no longer used, until Python looks for cycles.
    _APPLIERS: ClassVar[dict[type, Callable[["MapView", Any], None]]] = {
        deltas.RunSeen: _run_seen,
        deltas.FrameJoined: lambda view, of: view.frames.update({of.frame: of}),
        deltas.KeyframeAdded: _keyframe_added,
        deltas.ObservationAdded: _observation_added,
        deltas.EventSkipped: _event_skipped,
        deltas.PlaceFormed: _place_formed,
        deltas.PlacesMerged: _places_merged,
        deltas.MergeRefused: lambda *_: None,  # the places stay as they are
        deltas.KeyframePlaced: _keyframe_placed,
        deltas.PlaceChanged: _place_changed,
        deltas.PlaceNamed: _place_named,
        deltas.ObjectFound: _object_found,
        deltas.ObjectSeen: _object_seen,
        deltas.ObjectsMerged: _objects_merged,
        deltas.ObjectEstimated: _object_estimated,
        deltas.ObjectClassified: _object_classified,
        deltas.ObjectMissing: _object_missing,
        deltas.ObjectRelocated: _object_relocated,
        deltas.ObjectMoved: _object_moved,
        deltas.PlacesLinked: _places_linked,
        deltas.MapGiven: _map_given,
    }

    def counts(self) -> dict[str, int]:
        """Counts by name, in capitals those of the graph's edges; rare ones come at the end."""
        posed, fused, foreign = self._sums()
        unstated = self.without_camera() if self.settings.wants_camera else 0
        placed = sum(p.keyframe_count for p in self.places.values())
        return {
            "events": self.next_offset,
            "runs": len(self.runs),
            "keyframes": len(self.keyframes),
            "poses": posed,
            "observations": len(self.observations),
            "objects": len(self.objects),
            "confirmed": sum(o.confirmed for o in self.objects.values()),
            "places": len(self.places),
            "noise": posed - placed,
            "adjacency": len(self.adjacency),
            "duplicates": self.skipped["duplicate"],
            "conflicts": self.skipped["conflict"],
            "det_ids_reused": self.skipped["det_id_reused"],
            "foreign_embeddings": foreign,
            "HAS_KEYFRAME": len(self.keyframes),
            "HAS_POSE": posed,
            "HAS_OBSERVATION": len(self.observations),
            "OBSERVES": fused,
            "LOCATED_IN": sum(o.place is not None for o in self.objects.values()),
            "IN_PLACE": placed,
            "ADJACENT_TO": len(self.adjacency),
            "floors": len(self.floors),
            "buildings": int(bool(self.all_places or self.floors)),
            "PART_OF": len(self.places) + len(self.floors),
            **{kind: self.skipped[kind] for kind in _RARELY if kind in self.skipped},
            **({"without_camera": unstated} if unstated else {}),
        }

    def embedded(self) -> NDArray[np.int64]:
        """The observations with a vector of the map's space, ascending; none without embeddings."""
        return np.array([o.ordinal for o in self.observations if o.embedding is not None], np.int64)

    def vectors(self, observations: NDArray[np.int64]) -> NDArray[np.int32]:
        """The unit vectors of some of `embedded`, in units of 2⁻²⁰, shape (n, dim)."""
        return np.array([self.observations[n].embedding for n in observations.tolist()], np.int32)

    def _sums(self) -> tuple[int, int, int]:
        """Numbers of posed keyframes, of fused observations, and of those of foreign spaces."""
        posed = sum(k.pose is not None for k in self.keyframes)
        fused = sum(o.object is not None for o in self.observations)
        return posed, fused, sum(o.foreign_space for o in self.observations)

    def without_camera(self) -> int:
        """The number of keyframes with observations whose envelopes do not state a camera."""
        return sum(k.camera is None and bool(k.observations) for k in self.keyframes)
