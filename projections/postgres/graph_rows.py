"""The rows of the graph that a batch of events adds, changes and removes.

Two kinds of rows. *Fixed* ones are written once, when their event is folded: Keyframe, Pose,
Observation and the edges HAS_KEYFRAME, HAS_POSE, HAS_OBSERVATION, OBSERVES (an observation is fused
by the event that adds it, or never). *Changing* ones can get other values later: Run, Object,
Place, Floor, Building and the edges LOCATED_IN, IN_PLACE, ADJACENT_TO, PART_OF. Where two Objects
may become one, by a correction or under fusion by evidence, OBSERVES is a changing one too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from projections.map.changes import BatchChanges
from projections.map.view import MapView

from .graph_render import (
    BASE,
    adjacent_to_rows,
    building_rows,
    expected_rows,
    floor_rows,
    has_keyframe_rows,
    has_observation_rows,
    has_pose_rows,
    in_place_rows,
    keyframe_rows,
    located_in_rows,
    object_rows,
    observation_rows,
    observes_rows,
    part_of_rows,
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
    "Floor",
    "Building",
    "PART_OF",
)


@dataclass(frozen=True, slots=True)
class GraphRows:
    """Rows to insert (never seen before), to upsert, and graphids to delete, by label.

    ``replaced`` are edges to delete and insert again, of labels without upsert. They are deleted by
    their start vertices, so each must be the only edge of its label that starts at its vertex.
    """

    inserted: dict[Label, list[Any]]
    upserted: dict[Label, list[Any]]
    deleted: dict[Label, list[int]]
    replaced: dict[Label, list[Any]]


def fixed_rows(
    view: MapView, keyframes: Sequence[int], observations: Sequence[int]
) -> dict[Label, list[Any]]:
    """The rows of these keyframes and observations that can never change again."""
    rows = _new_rows(view, keyframes, observations)
    if _objects_may_merge(view):
        rows.pop("OBSERVES", None)
    return rows


def _objects_may_merge(view: MapView) -> bool:
    return view.settings.fusion == "evidence" or bool(view.corrections.same)


def _new_rows(
    view: MapView, keyframes: Sequence[int], observations: Sequence[int]
) -> dict[Label, list[Any]]:
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


def changing_rows(view: MapView) -> dict[Label, list[Any]]:
    """All rows of the map that a later event may change."""
    labels = (*CHANGING, "OBSERVES") if _objects_may_merge(view) else CHANGING
    rows = {label: list(expected_rows(view, label)) for label in labels}
    return {label: found for label, found in rows.items() if found}


def changed_rows(changes: BatchChanges, view: MapView) -> GraphRows:
    """The rows to insert, upsert and delete after a batch."""
    upserted: dict[Label, list[Any]] = {
        "Run": list(run_rows(view, changes.runs)),
        "Object": list(object_rows(view, filter(view.objects.__contains__, changes.objects))),
        "Place": list(place_rows(view, filter(view.places.__contains__, changes.places))),
        "LOCATED_IN": list(
            located_in_rows(view, filter(view.objects.__contains__, changes.located))
        ),
        "IN_PLACE": list(in_place_rows(view, changes.placed)),
        "ADJACENT_TO": list(adjacent_to_rows(view, changes.links)),
        "Floor": list(floor_rows(view, changes.floors)),
        "Building": list(building_rows(view)) if changes.formed or changes.floors else [],
        "PART_OF": list(
            part_of_rows(view, filter(view.places.__contains__, changes.formed), changes.floors)
        ),
    }
    gone = [p for p in changes.places if p not in view.places]
    absorbed = [o for o in changes.objects if o not in view.objects]
    nowhere = [o for o in changes.located if view.all_objects[o].place is None]
    deleted: dict[Label, list[int]] = {
        "Place": [BASE["Place"] + p for p in gone],
        "PART_OF": [BASE["PART_OF"] + p for p in gone],
        "Object": [BASE["Object"] + o for o in absorbed],
        "LOCATED_IN": [BASE["LOCATED_IN"] + o for o in sorted({*absorbed, *nowhere})],
        "ADJACENT_TO": [
            graphid_base("ADJACENT_TO") + adjacency_number(a, b)
            for a, b in changes.links
            if (a, b) not in view.adjacency
        ],
    }
    earlier = [o for o in changes.reassigned if o not in changes.observations]
    reassigned = list(observes_rows(view, earlier))
    return GraphRows(
        _new_rows(view, changes.keyframes, changes.observations),
        {label: rows for label, rows in upserted.items() if rows},
        {label: ids for label, ids in deleted.items() if ids},
        {"OBSERVES": reassigned} if reassigned else {},
    )
