"""From deltas to rows of the graph: which rows changed, and what they say now.

Two kinds of rows. *Fixed* ones are written once, when their event is folded: Keyframe, Pose,
Observation and the edges HAS_KEYFRAME, HAS_POSE, HAS_OBSERVATION, OBSERVES (an observation is fused
by the event that adds it, or never). *Changing* ones say something else later: Run, Object, Place
and the edges LOCATED_IN, IN_PLACE, ADJACENT_TO. For those only *which* is remembered; what they say
is read from the view when the rows are taken, so a thousand changes of one Object in a batch are
one row.

A tail asks `GraphRows` what changed. A rebuild wants everything, once: `WholeGraph` needs no deltas
for that, only the view.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

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
from projections.model.view import MapView

from .graph_render import (
    BASE,
    adjacent_to_rows,
    expected_rows,
    has_keyframe_rows,
    has_observation_rows,
    has_pose_rows,
    in_place_rows,
    keyframe_rows,
    located_in_rows,
    object_rows,
    observation_rows,
    observes_rows,
    place_rows,
    pose_rows,
    run_rows,
)
from .labels import Label, adjacency_number, graphid_base

CHANGING: Final[tuple[Label, ...]] = (
    "Run",
    "Object",
    "Place",
    "LOCATED_IN",
    "IN_PLACE",
    "ADJACENT_TO",
)


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


def fixed_rows(
    view: MapView, keyframes: Sequence[int], observations: Sequence[int]
) -> dict[Label, list[Any]]:
    """The rows of these keyframes and observations that can never change again."""
    rows: dict[Label, list[Any]] = {
        "Keyframe": list(keyframe_rows(view, keyframes)),
        "Pose": list(pose_rows(view, keyframes)),
        "Observation": list(observation_rows(view, observations)),
        "HAS_KEYFRAME": list(has_keyframe_rows(view, keyframes)),
        "HAS_POSE": list(has_pose_rows(view, keyframes)),
        "HAS_OBSERVATION": list(has_observation_rows(view, observations)),
        "OBSERVES": list(observes_rows(view, observations)),
    }
    return {label: found for label, found in rows.items() if found}


class WholeGraph:
    """Every row of a growing map, once: the fixed ones in stretches, the changing ones last."""

    def __init__(self) -> None:
        self._keyframes = 0
        self._observations = 0

    def waiting(self, view: MapView) -> int:
        """How many keyframes and observations `take_fixed` would write."""
        return len(view.keyframes) - self._keyframes + len(view.observations) - self._observations

    def take_fixed(self, view: MapView) -> GraphChanges:
        """The fixed rows that have come since the last time."""
        keyframes = range(self._keyframes, len(view.keyframes))
        observations = range(self._observations, len(view.observations))
        self._keyframes, self._observations = keyframes.stop, observations.stop
        return GraphChanges(fixed_rows(view, keyframes, observations))

    def take_rest(self, view: MapView) -> GraphChanges:
        """All rows that are still missing, when nothing more will come."""
        changes = self.take_fixed(view)
        for label in CHANGING:
            if rows := list(expected_rows(view, label)):
                changes.inserted[label] = rows
        return changes


class GraphRows:
    """Collects what a stream of deltas changed. `note` each delta *before* the view applies it."""

    def __init__(self) -> None:
        self._forget_fixed()
        self._forget_changing()

    def note(self, deltas: Iterable[Delta], view: MapView) -> None:
        """Remember what an event's deltas will change; ``view`` has not applied them yet."""
        for delta in deltas:
            noter = self._NOTERS.get(type(delta))
            if noter is not None:
                noter(self, delta, view)

    def take(self, view: MapView) -> GraphChanges:
        """All rows that changed since the last take, as ``view`` has them now."""
        changes = GraphChanges(fixed_rows(view, self._keyframes, self._observations))
        self._forget_fixed()
        self._take_changing(view, changes)
        return changes

    def _take_changing(self, view: MapView, changes: GraphChanges) -> None:
        upserted: dict[Label, list[Any]] = {
            "Run": list(run_rows(view, sorted(self._runs))),
            "Object": list(object_rows(view, sorted(self._objects))),
            "Place": list(place_rows(view, sorted(self._places & view.places.keys()))),
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

    def _forget_changing(self) -> None:
        self._runs: set[int] = set()
        self._objects: set[int] = set()
        self._located: set[int] = set()
        self._places: set[int] = set()
        self._absorbed: set[int] = set()
        self._placed: set[int] = set()
        self._links: set[tuple[int, int]] = set()

    def _places_merged(self, delta: PlacesMerged, view: MapView) -> None:
        self._places.add(delta.survivor)
        for place in delta.absorbed:
            self._absorbed.add(place)
            self._placed.update(view.all_places[place].unordered_members)

    # Of the class, not bound to what collects; `MapView` says why.
    _NOTERS: ClassVar[dict[type, Callable[["GraphRows", Any, MapView], None]]] = {
        RunSeen: lambda self, d, _: self._runs.add(d.run),
        KeyframeAdded: lambda self, d, _: self._keyframes.append(d.keyframe),
        ObservationAdded: lambda self, d, _: self._observations.append(d.observation),
        ObjectFound: lambda self, d, _: self._objects.add(d.object),
        ObjectSeen: lambda self, d, _: self._objects.add(d.object),
        ObjectMoved: lambda self, d, _: self._located.add(d.object),
        PlaceFormed: lambda self, d, _: self._places.add(d.place),
        PlaceChanged: lambda self, d, _: self._places.add(d.place),
        KeyframePlaced: lambda self, d, _: self._placed.add(d.keyframe),
        PlacesMerged: _places_merged,
        PlacesLinked: lambda self, d, _: self._links.add((d.a, d.b)),
    }
