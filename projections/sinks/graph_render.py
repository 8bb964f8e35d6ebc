"""What a row of the graph says: its graphid, its ends, and its properties as agtype text."""

from collections.abc import Callable, Iterable, Iterator
from typing import Final

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
BASE: Final = {label: graphid_base(label) + 1 for label in LABELS}
"""The graphid of ordinal 0 of each label."""


def expected_rows(view: MapView, label: Label) -> Iterator[Row]:
    """Every row of a label that the map has, by graphid: what a table must hold, streamed."""
    keyframes, observations = range(len(view.keyframes)), range(len(view.observations))
    posed = (k for k in keyframes if view.keyframes[k].pose)
    fused = (o for o in observations if view.observations[o].object is not None)
    rows: dict[Label, Callable[[], Iterable[Row]]] = {
        "Run": lambda: (run_row(view, r) for r in range(len(view.runs))),
        "Keyframe": lambda: (keyframe_row(view, k) for k in keyframes),
        "Pose": lambda: (pose_row(view, k) for k in posed),
        "Observation": lambda: (observation_row(view, o) for o in observations),
        "Object": lambda: (object_row(view, o) for o in range(len(view.objects))),
        "Place": lambda: (place_row(view, p) for p in sorted(view.places)),
        "HAS_KEYFRAME": lambda: (has_keyframe_row(view, k) for k in keyframes),
        "HAS_POSE": lambda: (has_pose_row(k) for k in posed),
        "HAS_OBSERVATION": lambda: (has_observation_row(view, o) for o in observations),
        "OBSERVES": lambda: (observes_row(view, o) for o in fused),
        "LOCATED_IN": lambda: located_in_rows(view, range(len(view.objects))),
        "IN_PLACE": lambda: in_place_rows(view, keyframes),
        "ADJACENT_TO": lambda: adjacent_to_rows(view, sorted(view.adjacency)),
    }
    return iter(rows[label]())


def run_row(view: MapView, ordinal: int) -> VertexRow:
    """A Run."""
    run = view.runs[ordinal]
    properties = f'{{"run_id": {text(run.run_id)}, "started_at": {number(run.started_at)}}}'
    return BASE["Run"] + ordinal, properties


def keyframe_row(view: MapView, ordinal: int) -> VertexRow:
    """A Keyframe."""
    k = view.keyframes[ordinal]
    return BASE["Keyframe"] + ordinal, (
        f'{{"run_id": {text(k.run_id)}, "keyframe_id": {k.keyframe_id},'
        f' "timestamp": {number(k.timestamp)}}}'
    )


def pose_row(view: MapView, ordinal: int) -> VertexRow:
    """The Pose of a keyframe that has one."""
    k = view.keyframes[ordinal]
    assert k.pose is not None  # noqa: S101 - the caller filtered
    return BASE["Pose"] + ordinal, (
        f'{{"run_id": {text(k.run_id)}, "keyframe_id": {k.keyframe_id},'
        f' "map_x": {number(k.pose.x_um / UM_PER_M)}, "map_y": {number(k.pose.y_um / UM_PER_M)},'
        f' "map_yaw": {number(k.pose.yaw_rad)}}}'
    )


def observation_row(view: MapView, ordinal: int) -> VertexRow:
    """An Observation."""
    o = view.observations[ordinal]
    k = view.keyframes[o.keyframe]
    return BASE["Observation"] + ordinal, (
        f'{{"det_id": {text(o.det_id)}, "class_name": {text(o.class_name)},'
        f' "confidence": {number(o.confidence)}, "bbox": {numbers(o.bbox)},'
        f' "run_id": {text(k.run_id)}, "keyframe_id": {k.keyframe_id}}}'
    )


def object_row(view: MapView, ordinal: int) -> VertexRow:
    """An Object."""
    o = view.objects[ordinal]
    return BASE["Object"] + ordinal, (
        f'{{"object_id": {text(o.object_id)}, "class_name": {text(o.class_name)},'
        f' "mean_x": {number(o.mean_x)}, "mean_y": {number(o.mean_y)}, "obs_count": {o.obs_count},'
        f' "first_seen": {number(o.first_seen)}, "last_seen": {number(o.last_seen)}}}'
    )


def place_row(view: MapView, ordinal: int) -> VertexRow:
    """A Place, also one that was absorbed."""
    p = view.all_places[ordinal]
    return BASE["Place"] + ordinal, (
        f'{{"place_id": {text(p.place_id)}, "centroid_x": {number(p.centroid_x)},'
        f' "centroid_y": {number(p.centroid_y)}, "keyframe_count": {p.keyframe_count}}}'
    )


def has_keyframe_row(view: MapView, k: int) -> EdgeRow:
    """The edge from its run to keyframe ``k``."""
    run = BASE["Run"] + view.keyframes[k].run
    return BASE["HAS_KEYFRAME"] + k, run, BASE["Keyframe"] + k, _NONE


def has_pose_row(k: int) -> EdgeRow:
    """The edge from keyframe ``k`` to its pose."""
    return BASE["HAS_POSE"] + k, BASE["Keyframe"] + k, BASE["Pose"] + k, _NONE


def has_observation_row(view: MapView, o: int) -> EdgeRow:
    """The edge from its keyframe to observation ``o``."""
    keyframe = BASE["Keyframe"] + view.observations[o].keyframe
    return BASE["HAS_OBSERVATION"] + o, keyframe, BASE["Observation"] + o, _NONE


def observes_row(view: MapView, ordinal: int) -> EdgeRow:
    """The edge from a fused observation to its object."""
    o = view.observations[ordinal]
    assert o.object is not None  # noqa: S101 - ObjectSeen was applied
    assert o.similarity_q40 is not None  # noqa: S101
    return (
        BASE["OBSERVES"] + ordinal,
        BASE["Observation"] + ordinal,
        BASE["Object"] + o.object,
        f'{{"similarity": {number(o.similarity_q40 / Q40)}}}',
    )


def located_in_rows(view: MapView, objects: Iterable[int]) -> Iterator[EdgeRow]:
    """The edges of those objects that are in a place."""
    for o in objects:
        place = view.objects[o].place
        if place is not None:
            yield BASE["LOCATED_IN"] + o, BASE["Object"] + o, BASE["Place"] + place, _NONE


def in_place_rows(view: MapView, keyframes: Iterable[int]) -> Iterator[EdgeRow]:
    """The edges of those keyframes that are in a place."""
    for k in keyframes:
        place = view.keyframes[k].place
        if place is not None:
            yield BASE["IN_PLACE"] + k, BASE["Keyframe"] + k, BASE["Place"] + place, _NONE


def adjacent_to_rows(view: MapView, links: Iterable[tuple[int, int]]) -> Iterator[EdgeRow]:
    """The edges of those pairs of places that still have one."""
    base = graphid_base("ADJACENT_TO")
    for a, b in links:
        shared = view.adjacency.get((a, b))
        if shared is not None:
            properties = f'{{"shared_transitions": {shared}}}'
            edge = base + adjacency_number(a, b)
            yield edge, BASE["Place"] + a, BASE["Place"] + b, properties
