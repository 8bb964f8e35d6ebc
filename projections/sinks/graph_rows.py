"""From deltas to rows of the graph: which rows changed, and what they say now.

Two kinds of rows. *Fixed* ones are written once, when their event is folded: Keyframe, Pose,
Observation and the edges HAS_KEYFRAME, HAS_POSE, HAS_OBSERVATION, OBSERVES. *Changing* ones say
something else later: Run, Object, Place and the edges LOCATED_IN, IN_PLACE, ADJACENT_TO. For those
only *which* is remembered; what they say is read from the view when the rows are taken, so a
thousand changes of one Object in a batch are one row.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from projections.deltas import (
    Delta,
    KeyframeAdded,
    KeyframePlaced,
    ObjectFound,
    ObjectMoved,
    ObjectSeen,
    ObservationAdded,
    PlaceChanged,
    PlaceFormed,
    PlacesLinked,
    PlacesMerged,
    RunSeen,
)
from projections.exact import Q40, UM_PER_M
from projections.view import MapView

from .agtype import number, numbers, text
from .labels import LABELS, Label, adjacency_number, graphid_base

VertexRow = tuple[int, str]
"""graphid, properties as agtype text."""
EdgeRow = tuple[int, int, int, str]
"""graphid, start, end, properties as agtype text."""
Row = VertexRow | EdgeRow

_NONE: Final = "{}"
_BASE: Final = {label: graphid_base(label) + 1 for label in LABELS}
"""The graphid of ordinal 0 of each label."""


@dataclass(slots=True)
class GraphChanges:
    """Rows to insert (never seen before), to upsert, and graphids to delete, by label."""

    inserted: dict[Label, list[Any]] = field(default_factory=dict)
    upserted: dict[Label, list[Any]] = field(default_factory=dict)
    deleted: dict[Label, list[int]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return any(
            rows for part in (self.inserted, self.upserted, self.deleted) for rows in part.values()
        )


class GraphRows:
    """Collects what a stream of deltas changed. `note` each delta *before* the view applies it."""

    def __init__(self) -> None:
        self._forget_fixed()
        self._forget_changing()
        self._noters: dict[type, Callable[[Any, MapView], None]] = {
            RunSeen: lambda d, _: self._runs.add(d.run),
            KeyframeAdded: lambda d, _: self._keyframes.append(d.keyframe),
            ObservationAdded: lambda d, _: self._observations.append(d.observation),
            ObjectFound: lambda d, _: self._objects.add(d.object),
            ObjectSeen: self._object_seen,
            ObjectMoved: lambda d, _: self._located.add(d.object),
            PlaceFormed: lambda d, _: self._places.add(d.place),
            PlaceChanged: lambda d, _: self._places.add(d.place),
            KeyframePlaced: lambda d, _: self._placed.add(d.keyframe),
            PlacesMerged: self._places_merged,
            PlacesLinked: lambda d, _: self._links.add((d.a, d.b)),
        }

    def note(self, delta: Delta, view: MapView) -> None:
        """Remember what ``delta`` will change; ``view`` has not applied it yet."""
        noter = self._noters.get(type(delta))
        if noter is not None:
            noter(delta, view)

    @property
    def fixed_waiting(self) -> int:
        """How many observations and keyframes `take_fixed` would write."""
        return len(self._keyframes) + len(self._observations)

    def take(self, view: MapView) -> GraphChanges:
        """All rows that changed since the last take, as ``view`` has them now."""
        changes = GraphChanges(self.take_fixed(view))
        self._take_changing(view, changes)
        return changes

    def take_fixed(self, view: MapView) -> dict[Label, list[Any]]:
        """Only the rows that can never change again; the rest stays remembered."""
        keyframes, observations, observes = self._keyframes, self._observations, self._observes
        self._forget_fixed()
        rows: dict[Label, list[Any]] = {
            "Keyframe": [_keyframe(view, k) for k in keyframes],
            "Pose": [_pose(view, k) for k in keyframes if view.keyframes[k].pose],
            "Observation": [_observation(view, o) for o in observations],
            "HAS_KEYFRAME": [_has_keyframe(view, k) for k in keyframes],
            "HAS_POSE": [_has_pose(k) for k in keyframes if view.keyframes[k].pose],
            "HAS_OBSERVATION": [_has_observation(view, o) for o in observations],
            "OBSERVES": [_observes(view, o) for o in observes],
        }
        return {label: found for label, found in rows.items() if found}

    def _take_changing(self, view: MapView, changes: GraphChanges) -> None:
        upserted: dict[Label, list[Any]] = {
            "Run": [_run(view, r) for r in sorted(self._runs)],
            "Object": [_object(view, o) for o in sorted(self._objects)],
            "Place": [_place(view, p) for p in sorted(self._places) if p in view.places],
            "LOCATED_IN": list(_located_in(view, sorted(self._located))),
            "IN_PLACE": list(_in_place(view, sorted(self._placed))),
            "ADJACENT_TO": list(_adjacent_to(view, sorted(self._links))),
        }
        gone = [p for p in sorted(self._places | self._absorbed) if p not in view.places]
        unlocated = [o for o in sorted(self._located) if view.objects[o].place is None]
        unlinked = [link for link in sorted(self._links) if link not in view.adjacency]
        deleted: dict[Label, list[int]] = {
            "Place": [_BASE["Place"] + p for p in gone],
            "LOCATED_IN": [_BASE["LOCATED_IN"] + o for o in unlocated],
            "ADJACENT_TO": [
                graphid_base("ADJACENT_TO") + adjacency_number(a, b) for a, b in unlinked
            ],
        }
        self._forget_changing()
        changes.upserted = {label: rows for label, rows in upserted.items() if rows}
        changes.deleted = {label: ids for label, ids in deleted.items() if ids}

    def _forget_fixed(self) -> None:
        self._keyframes: list[int] = []
        self._observations: list[int] = []
        self._observes: list[int] = []

    def _forget_changing(self) -> None:
        self._runs: set[int] = set()
        self._objects: set[int] = set()
        self._located: set[int] = set()
        self._places: set[int] = set()
        self._absorbed: set[int] = set()
        self._placed: set[int] = set()
        self._links: set[tuple[int, int]] = set()

    def _object_seen(self, delta: ObjectSeen, _view: MapView) -> None:
        self._objects.add(delta.object)
        self._observes.append(delta.observation)

    def _places_merged(self, delta: PlacesMerged, view: MapView) -> None:
        self._places.add(delta.survivor)
        for place in delta.absorbed:
            self._absorbed.add(place)
            self._placed.update(view.all_places[place].unordered_members)


def expected_rows(view: MapView, label: Label) -> Iterator[Row]:
    """Every row of a label that the map has, by graphid: what a table must hold, streamed."""
    keyframes, observations = range(len(view.keyframes)), range(len(view.observations))
    posed = (k for k in keyframes if view.keyframes[k].pose)
    fused = (o for o in observations if view.observations[o].object is not None)
    rows: dict[Label, Callable[[], Iterable[Row]]] = {
        "Run": lambda: (_run(view, r) for r in range(len(view.runs))),
        "Keyframe": lambda: (_keyframe(view, k) for k in keyframes),
        "Pose": lambda: (_pose(view, k) for k in posed),
        "Observation": lambda: (_observation(view, o) for o in observations),
        "Object": lambda: (_object(view, o) for o in range(len(view.objects))),
        "Place": lambda: (_place(view, p) for p in sorted(view.places)),
        "HAS_KEYFRAME": lambda: (_has_keyframe(view, k) for k in keyframes),
        "HAS_POSE": lambda: (_has_pose(k) for k in posed),
        "HAS_OBSERVATION": lambda: (_has_observation(view, o) for o in observations),
        "OBSERVES": lambda: (_observes(view, o) for o in fused),
        "LOCATED_IN": lambda: _located_in(view, range(len(view.objects))),
        "IN_PLACE": lambda: _in_place(view, keyframes),
        "ADJACENT_TO": lambda: _adjacent_to(view, sorted(view.adjacency)),
    }
    return iter(rows[label]())


def _run(view: MapView, ordinal: int) -> VertexRow:
    run = view.runs[ordinal]
    properties = f'{{"run_id": {text(run.run_id)}, "started_at": {number(run.started_at)}}}'
    return _BASE["Run"] + ordinal, properties


def _keyframe(view: MapView, ordinal: int) -> VertexRow:
    k = view.keyframes[ordinal]
    return _BASE["Keyframe"] + ordinal, (
        f'{{"run_id": {text(k.run_id)}, "keyframe_id": {k.keyframe_id},'
        f' "timestamp": {number(k.timestamp)}}}'
    )


def _pose(view: MapView, ordinal: int) -> VertexRow:
    k = view.keyframes[ordinal]
    assert k.pose is not None  # noqa: S101 - the caller filtered
    return _BASE["Pose"] + ordinal, (
        f'{{"run_id": {text(k.run_id)}, "keyframe_id": {k.keyframe_id},'
        f' "map_x": {number(k.pose.x_um / UM_PER_M)}, "map_y": {number(k.pose.y_um / UM_PER_M)},'
        f' "map_yaw": {number(k.pose.yaw_rad)}}}'
    )


def _observation(view: MapView, ordinal: int) -> VertexRow:
    o = view.observations[ordinal]
    k = view.keyframes[o.keyframe]
    return _BASE["Observation"] + ordinal, (
        f'{{"det_id": {text(o.det_id)}, "class_name": {text(o.class_name)},'
        f' "confidence": {number(o.confidence)}, "bbox": {numbers(o.bbox)},'
        f' "run_id": {text(k.run_id)}, "keyframe_id": {k.keyframe_id}}}'
    )


def _object(view: MapView, ordinal: int) -> VertexRow:
    o = view.objects[ordinal]
    return _BASE["Object"] + ordinal, (
        f'{{"object_id": {text(o.object_id)}, "class_name": {text(o.class_name)},'
        f' "mean_x": {number(o.mean_x)}, "mean_y": {number(o.mean_y)}, "obs_count": {o.obs_count},'
        f' "first_seen": {number(o.first_seen)}, "last_seen": {number(o.last_seen)}}}'
    )


def _place(view: MapView, ordinal: int) -> VertexRow:
    p = view.all_places[ordinal]
    return _BASE["Place"] + ordinal, (
        f'{{"place_id": {text(p.place_id)}, "centroid_x": {number(p.centroid_x)},'
        f' "centroid_y": {number(p.centroid_y)}, "keyframe_count": {p.keyframe_count}}}'
    )


def _has_keyframe(view: MapView, k: int) -> EdgeRow:
    run = _BASE["Run"] + view.keyframes[k].run
    return _BASE["HAS_KEYFRAME"] + k, run, _BASE["Keyframe"] + k, _NONE


def _has_pose(k: int) -> EdgeRow:
    return _BASE["HAS_POSE"] + k, _BASE["Keyframe"] + k, _BASE["Pose"] + k, _NONE


def _has_observation(view: MapView, o: int) -> EdgeRow:
    keyframe = _BASE["Keyframe"] + view.observations[o].keyframe
    return _BASE["HAS_OBSERVATION"] + o, keyframe, _BASE["Observation"] + o, _NONE


def _observes(view: MapView, ordinal: int) -> EdgeRow:
    o = view.observations[ordinal]
    assert o.object is not None  # noqa: S101 - ObjectSeen was applied
    assert o.similarity_q40 is not None  # noqa: S101
    return (
        _BASE["OBSERVES"] + ordinal,
        _BASE["Observation"] + ordinal,
        _BASE["Object"] + o.object,
        f'{{"similarity": {number(o.similarity_q40 / Q40)}}}',
    )


def _located_in(view: MapView, objects: Iterable[int]) -> Iterator[EdgeRow]:
    for o in objects:
        place = view.objects[o].place
        if place is not None:
            yield _BASE["LOCATED_IN"] + o, _BASE["Object"] + o, _BASE["Place"] + place, _NONE


def _in_place(view: MapView, keyframes: Iterable[int]) -> Iterator[EdgeRow]:
    for k in keyframes:
        place = view.keyframes[k].place
        if place is not None:
            yield _BASE["IN_PLACE"] + k, _BASE["Keyframe"] + k, _BASE["Place"] + place, _NONE


def _adjacent_to(view: MapView, links: Iterable[tuple[int, int]]) -> Iterator[EdgeRow]:
    base = graphid_base("ADJACENT_TO")
    for a, b in links:
        shared = view.adjacency.get((a, b))
        if shared is not None:
            properties = f'{{"shared_transitions": {shared}}}'
            edge = base + adjacency_number(a, b)
            yield edge, _BASE["Place"] + a, _BASE["Place"] + b, properties
