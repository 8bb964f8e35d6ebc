"""The map as data, built from deltas alone: `MapView` and its records.

A view knows no reducer: the same deltas, from a live fold, from a log or from a test's hand, give
the same view. Applying a delta twice does no harm. A merge moves the smaller member list into the
larger one and leaves keyframes with the place they joined; `KeyframeRecord.place` looks its
survivor up, so a merge costs little however many keyframes move.

Records are written by `MapView.apply` only. ``ordinal`` numbers the things of a kind in the order
in which the fold met or founded them. Positions are integer micrometres (``_um``) and exact; ``_m``
and ``_x``/``_y`` values are metres, correctly rounded. Times are robot seconds.
"""

import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar

from eventsrc.envelope import FIRST_OFFSET, DetId, KeyframeId, Offset, RunId
from projections.deltas import (
    Delta,
    EventSkipped,
    KeyframeAdded,
    KeyframeOrdinal,
    KeyframePlaced,
    ObjectFound,
    ObjectMoved,
    ObjectOrdinal,
    ObjectSeen,
    ObservationAdded,
    ObservationOrdinal,
    PlaceChanged,
    PlaceFormed,
    PlaceOrdinal,
    PlacesLinked,
    PlacesMerged,
    Pose,
    RunOrdinal,
    RunSeen,
    SkipKind,
    UnitVector,
)
from projections.exact import mean_m
from projections.reducers.survivors import PlaceSurvivors
from projections.settings import Settings


@dataclass(slots=True, eq=False)
class RunRecord:
    """One run. ``started_at`` is the earliest keyframe timestamp of it so far."""

    ordinal: RunOrdinal
    run_id: RunId
    started_at: float
    keyframe_count: int = 0


@dataclass(slots=True, eq=False)
class PlaceRecord:
    """A region of the building. ``founder`` is its first core keyframe.

    `MapView.places` lists those that were not absorbed.
    """

    ordinal: PlaceOrdinal
    place_id: str
    founder: KeyframeOrdinal
    founded_offset: Offset
    keyframe_count: int = 0
    sum_x_um: int = 0
    sum_y_um: int = 0
    unordered_members: list[KeyframeOrdinal] = field(default_factory=list)

    @property
    def members(self) -> list[KeyframeOrdinal]:
        """Ordinals of its keyframes, ascending; a new list each time."""
        return sorted(self.unordered_members)

    @property
    def centroid_x(self) -> float:
        """Metres; the mean of its members."""
        return mean_m(self.sum_x_um, self.keyframe_count)

    @property
    def centroid_y(self) -> float:
        """Metres; the mean of its members."""
        return mean_m(self.sum_y_um, self.keyframe_count)


@dataclass(slots=True, eq=False)
class KeyframeRecord:
    """One keyframe. ``offset`` is its event's; ``pose`` is None when the robot had none.

    ``joined`` is the place it joined, as of then; ``survivors`` are the view's.
    """

    ordinal: KeyframeOrdinal
    offset: Offset
    run: RunOrdinal
    run_id: RunId
    keyframe_id: KeyframeId
    timestamp: float
    pose: Pose | None
    survivors: PlaceSurvivors
    observations: list[ObservationOrdinal] | tuple[()] = ()
    joined: PlaceOrdinal | None = None

    @property
    def place(self) -> PlaceOrdinal | None:
        """The place it belongs to now; None for noise or without a pose."""
        return None if self.joined is None else self.survivors.find(self.joined)


@dataclass(slots=True, eq=False)
class ObservationRecord:
    """One detection. ``object`` and ``similarity_q40`` are None when it was not fused.

    ``embedding`` is None when there is none, when it is of a foreign space, or when the view was
    made with ``keep_embeddings=False``; ``embedding_crc`` is there even then.
    """

    ordinal: ObservationOrdinal
    keyframe: KeyframeOrdinal
    det_id: DetId
    class_name: str
    confidence: float
    bbox: tuple[float, float, float, float]
    embedding_model: str | None
    embedding: UnitVector | None
    embedding_crc: int | None
    foreign_space: bool
    object: ObjectOrdinal | None = None
    similarity_q40: int | None = None


@dataclass(slots=True, eq=False)
class ObjectRecord:
    """A landmark. ``observations`` are ordinals in the order in which they were fused."""

    ordinal: ObjectOrdinal
    object_id: str
    class_name: str
    obs_count: int = 0
    sum_x_um: int = 0
    sum_y_um: int = 0
    first_seen: float = 0.0
    last_seen: float = 0.0
    place: PlaceOrdinal | None = None
    observations: list[ObservationOrdinal] = field(default_factory=list)

    @property
    def mean_x(self) -> float:
        """Metres; the mean of the positions the robot observed it from."""
        return mean_m(self.sum_x_um, self.obs_count)

    @property
    def mean_y(self) -> float:
        """Metres; the mean of the positions the robot observed it from."""
        return mean_m(self.sum_y_um, self.obs_count)


class MapView:
    """A whole map state. Read its attributes; change it by `apply` and `advance` only.

    ``runs``, ``keyframes``, ``observations`` and ``objects`` are lists indexed by ordinal.
    ``places`` are those not absorbed, by ordinal, ascending; ``all_places`` also the absorbed, and
    ``survivors`` what these are part of now.
    ``adjacency`` maps (a, b), a founded before b, to shared transitions above 0; `edges` sorts it.
    ``next_offset`` is the number of events that went into the view.
    """

    def __init__(self, settings: Settings, *, keep_embeddings: bool = True) -> None:
        self.settings = settings
        self.keep_embeddings = keep_embeddings
        self.next_offset = FIRST_OFFSET
        self.runs: list[RunRecord] = []
        self.keyframes: list[KeyframeRecord] = []
        self.observations: list[ObservationRecord] = []
        self.objects: list[ObjectRecord] = []
        self.all_places: list[PlaceRecord] = []
        self.places: dict[PlaceOrdinal, PlaceRecord] = {}
        self.survivors = PlaceSurvivors()
        self.adjacency: dict[tuple[PlaceOrdinal, PlaceOrdinal], int] = {}
        self.skipped: dict[SkipKind, int] = {"duplicate": 0, "conflict": 0, "det_id_reused": 0}

    def apply(self, delta: Delta) -> None:
        """Apply one delta."""
        self._APPLIERS[type(delta)](self, delta)

    def apply_event(self, offset: Offset, deltas: Iterable[Delta]) -> None:
        """Apply all deltas of the event at ``offset`` and advance past it."""
        appliers = self._APPLIERS
        for delta in deltas:
            appliers[type(delta)](self, delta)
        self.next_offset = Offset(offset + 1)

    def advance(self, next_offset: Offset) -> None:
        """Set ``next_offset``: all events below it are in the view."""
        self.next_offset = next_offset

    def place_id(self, place: PlaceOrdinal | None) -> str | None:
        """The id of a place, absorbed ones too; None for None."""
        return None if place is None else self.all_places[place].place_id

    def edges(self) -> list[tuple[PlaceOrdinal, PlaceOrdinal, int]]:
        """(a, b, shared_transitions), ascending."""
        return [(a, b, n) for (a, b), n in sorted(self.adjacency.items())]

    def _run_seen(self, delta: RunSeen) -> None:
        if delta.run == len(self.runs):
            self.runs.append(RunRecord(delta.run, delta.run_id, delta.started_at))
        else:
            self.runs[delta.run].started_at = delta.started_at

    def _keyframe_added(self, delta: KeyframeAdded) -> None:
        if delta.keyframe < len(self.keyframes):
            return
        self.runs[delta.run].keyframe_count += 1
        self.keyframes.append(
            KeyframeRecord(
                delta.keyframe,
                delta.offset,
                delta.run,
                delta.run_id,
                delta.keyframe_id,
                delta.timestamp,
                delta.pose,
                self.survivors,
            )
        )

    def _observation_added(self, delta: ObservationAdded) -> None:
        if delta.observation < len(self.observations):
            return
        keyframe = self.keyframes[delta.keyframe]
        if isinstance(keyframe.observations, tuple):
            keyframe.observations = []
        keyframe.observations.append(delta.observation)
        vector = delta.embedding
        self.observations.append(
            ObservationRecord(
                delta.observation,
                delta.keyframe,
                delta.det_id,
                delta.class_name,
                delta.confidence,
                delta.bbox,
                delta.embedding_model,
                vector if self.keep_embeddings else None,
                None if vector is None else zlib.crc32(vector.data),
                delta.foreign_space,
            )
        )

    def _event_skipped(self, delta: EventSkipped) -> None:
        if delta.offset >= self.next_offset:
            self.skipped[delta.kind] += 1

    def _place_formed(self, delta: PlaceFormed) -> None:
        if delta.place < len(self.all_places):
            return
        place = PlaceRecord(delta.place, delta.place_id, delta.founder, delta.offset)
        self.all_places.append(place)
        self.places[delta.place] = place

    def _places_merged(self, delta: PlacesMerged) -> None:
        survivor = self.all_places[delta.survivor]
        for ordinal in delta.absorbed:
            absorbed = self.places.pop(ordinal, None)
            if absorbed is None:
                continue
            small, large = absorbed.unordered_members, survivor.unordered_members
            if len(small) > len(large):
                small, large = large, small
            large.extend(small)
            survivor.unordered_members = large
            absorbed.unordered_members = []
            self.survivors.merge(delta.survivor, (ordinal,))

    def _keyframe_placed(self, delta: KeyframePlaced) -> None:
        keyframe = self.keyframes[delta.keyframe]
        if keyframe.joined is None:
            keyframe.joined = delta.place
            self.all_places[delta.place].unordered_members.append(delta.keyframe)

    def _place_changed(self, delta: PlaceChanged) -> None:
        place = self.all_places[delta.place]
        place.keyframe_count = delta.keyframe_count
        place.sum_x_um = delta.sum_x_um
        place.sum_y_um = delta.sum_y_um

    def _object_found(self, delta: ObjectFound) -> None:
        if delta.object == len(self.objects):
            self.objects.append(ObjectRecord(delta.object, delta.object_id, delta.class_name))

    def _object_seen(self, delta: ObjectSeen) -> None:
        found = self.objects[delta.object]
        observation = self.observations[delta.observation]
        if observation.object is None:
            observation.object = delta.object
            observation.similarity_q40 = delta.similarity_q40
            found.observations.append(delta.observation)
        found.obs_count = delta.obs_count
        found.sum_x_um = delta.sum_x_um
        found.sum_y_um = delta.sum_y_um
        found.first_seen = delta.first_seen
        found.last_seen = delta.last_seen

    def _object_moved(self, delta: ObjectMoved) -> None:
        self.objects[delta.object].place = delta.place

    def _places_linked(self, delta: PlacesLinked) -> None:
        if delta.shared_transitions:
            self.adjacency[delta.a, delta.b] = delta.shared_transitions
        else:
            self.adjacency.pop((delta.a, delta.b), None)

    # Functions of the class, not bound methods: a view that refers to itself would stay in memory,
    # once it is no longer used, until Python looks for cycles.
    _APPLIERS: ClassVar[dict[type, Callable[["MapView", Any], None]]] = {
        RunSeen: _run_seen,
        KeyframeAdded: _keyframe_added,
        ObservationAdded: _observation_added,
        EventSkipped: _event_skipped,
        PlaceFormed: _place_formed,
        PlacesMerged: _places_merged,
        KeyframePlaced: _keyframe_placed,
        PlaceChanged: _place_changed,
        ObjectFound: _object_found,
        ObjectSeen: _object_seen,
        ObjectMoved: _object_moved,
        PlacesLinked: _places_linked,
    }

    def counts(self) -> dict[str, int]:
        """How many of everything; the last seven are the graph's edges by label."""
        posed = sum(k.pose is not None for k in self.keyframes)
        placed = sum(p.keyframe_count for p in self.places.values())
        return {
            "events": self.next_offset,
            "runs": len(self.runs),
            "keyframes": len(self.keyframes),
            "poses": posed,
            "observations": len(self.observations),
            "objects": len(self.objects),
            "places": len(self.places),
            "noise": posed - placed,
            "adjacency": len(self.adjacency),
            "duplicates": self.skipped["duplicate"],
            "conflicts": self.skipped["conflict"],
            "det_ids_reused": self.skipped["det_id_reused"],
            "foreign_embeddings": sum(o.foreign_space for o in self.observations),
            "HAS_KEYFRAME": len(self.keyframes),
            "HAS_POSE": posed,
            "HAS_OBSERVATION": len(self.observations),
            "OBSERVES": sum(o.object is not None for o in self.observations),
            "LOCATED_IN": sum(o.place is not None for o in self.objects),
            "IN_PLACE": placed,
            "ADJACENT_TO": len(self.adjacency),
        }
