"""From deltas to rows of the graph: which rows changed, and what they say now.

Two kinds of rows. *Fixed* ones are written once, when their event is folded: Keyframe, Pose,
Observation and the edges HAS_KEYFRAME, HAS_POSE, HAS_OBSERVATION, OBSERVES. *Changing* ones say
something else later: Run, Object, Place and the edges LOCATED_IN, IN_PLACE, ADJACENT_TO. For those
only *which* is remembered; what they say is read from the view when the rows are taken, so a
thousand changes of one Object in a batch are one row.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

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
from projections.view import MapView

from .graph_render import (
    BASE,
    adjacent_to_rows,
    has_keyframe_row,
    has_observation_row,
    has_pose_row,
    in_place_rows,
    keyframe_row,
    located_in_rows,
    object_row,
    observation_row,
    observes_row,
    place_row,
    pose_row,
    run_row,
)
from .labels import Label, adjacency_number, graphid_base


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
            "Keyframe": [keyframe_row(view, k) for k in keyframes],
            "Pose": [pose_row(view, k) for k in keyframes if view.keyframes[k].pose],
            "Observation": [observation_row(view, o) for o in observations],
            "HAS_KEYFRAME": [has_keyframe_row(view, k) for k in keyframes],
            "HAS_POSE": [has_pose_row(k) for k in keyframes if view.keyframes[k].pose],
            "HAS_OBSERVATION": [has_observation_row(view, o) for o in observations],
            "OBSERVES": [observes_row(view, o) for o in observes],
        }
        return {label: found for label, found in rows.items() if found}

    def _take_changing(self, view: MapView, changes: GraphChanges) -> None:
        upserted: dict[Label, list[Any]] = {
            "Run": [run_row(view, r) for r in sorted(self._runs)],
            "Object": [object_row(view, o) for o in sorted(self._objects)],
            "Place": [place_row(view, p) for p in sorted(self._places) if p in view.places],
            "LOCATED_IN": list(located_in_rows(view, sorted(self._located))),
            "IN_PLACE": list(in_place_rows(view, sorted(self._placed))),
            "ADJACENT_TO": list(adjacent_to_rows(view, sorted(self._links))),
        }
        gone = [p for p in sorted(self._places | self._absorbed) if p not in view.places]
        unlocated = [o for o in sorted(self._located) if view.objects[o].place is None]
        unlinked = [link for link in sorted(self._links) if link not in view.adjacency]
        deleted: dict[Label, list[int]] = {
            "Place": [BASE["Place"] + p for p in gone],
            "LOCATED_IN": [BASE["LOCATED_IN"] + o for o in unlocated],
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
