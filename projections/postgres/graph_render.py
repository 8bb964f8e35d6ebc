"""Rows of the graph as AGE stores them: graphid, ends of an edge, properties as agtype text.

agtype's text is JSON with two differences that matter: integer and float are different types, and a
number is a float exactly when it is written with a point or an exponent. Python's ``repr`` of a
float always has one of the two and is the shortest text for that float; the server reads it back to
the same bits. Strings are escaped as JSON has it: quote, backslash and control characters.

Most floats of a map are written by ``repr`` alone, which is `number` without its check: they are
finite, as the envelope refuses others, and so would the server.

Nothing here is query text. The result is a *value*: a bind parameter or a field of COPY data.
"""

from collections.abc import Callable, Iterable, Iterator
from json.encoder import encode_basestring
from typing import Final

from projections.fold.deltas import PlaceOrdinal
from projections.fold.exact import Q40, UM_PER_M
from projections.map.records import KeyframeRecord, ObjectRecord
from projections.map.view import MapView

from .labels import LABELS, Label, adjacency_number, floor_part_number, graphid_base


def text(value: str) -> str:
    """A string. It must hold no NUL and no lone surrogate, which PostgreSQL cannot store."""
    return encode_basestring(value)


def number(value: float) -> str:
    """A finite float, -0.0 and 1e22 included; ints are written by ``str``."""
    written = repr(float(value))
    if written[-1] in "fn":  # inf, nan
        raise ValueError(f"{value} is no number a graph can hold")
    return written


VertexRow = tuple[int, str]
"""graphid, properties as agtype text."""
EdgeRow = tuple[int, int, int, str]
"""graphid, start, end, properties as agtype text."""
Row = VertexRow | EdgeRow

_NONE: Final = "{}"
BUILDING_ID: Final = "building"
"""A map is of one building."""
BASE: Final = {label: graphid_base(label) + 1 for label in LABELS}
"""The graphid of ordinal 0 of each label."""


def expected_rows(view: MapView, label: Label) -> Iterator[Row]:
    """All rows that the table of a label must hold, by graphid."""
    keyframes, observations = range(len(view.keyframes)), range(len(view.observations))
    objects = sorted(view.objects)
    rows: dict[Label, Callable[[], Iterator[Row]]] = {
        "Run": lambda: run_rows(view, range(len(view.runs))),
        "Keyframe": lambda: keyframe_rows(view, keyframes),
        "Pose": lambda: pose_rows(view, keyframes),
        "Observation": lambda: observation_rows(view, observations),
        "Object": lambda: object_rows(view, objects),
        "Place": lambda: place_rows(view, sorted(view.places)),
        "HAS_KEYFRAME": lambda: has_keyframe_rows(view, keyframes),
        "HAS_POSE": lambda: has_pose_rows(view, keyframes),
        "HAS_OBSERVATION": lambda: has_observation_rows(view, observations),
        "OBSERVES": lambda: observes_rows(view, observations),
        "LOCATED_IN": lambda: located_in_rows(view, objects),
        "IN_PLACE": lambda: in_place_rows(view, keyframes),
        "ADJACENT_TO": lambda: adjacent_to_rows(view, sorted(view.adjacency)),
        "Floor": lambda: floor_rows(view, range(len(view.floors))),
        "Building": lambda: building_rows(view),
        "PART_OF": lambda: part_of_rows(view, sorted(view.places), range(len(view.floors))),
    }
    return rows[label]()


def run_rows(view: MapView, runs: Iterable[int]) -> Iterator[VertexRow]:
    """Runs."""
    for i in runs:
        run = view.runs[i]
        properties = f'{{"run_id": {text(run.run_id)}, "started_at": {number(run.started_at)}}}'
        yield BASE["Run"] + i, properties


def keyframe_rows(view: MapView, keyframes: Iterable[int]) -> Iterator[VertexRow]:
    """Keyframes."""
    base = BASE["Keyframe"]
    for i in keyframes:
        k = view.keyframes[i]
        yield base + i, f'{{{_keyframe_key(k)}, "timestamp": {k.timestamp!r}}}'


def pose_rows(view: MapView, keyframes: Iterable[int]) -> Iterator[VertexRow]:
    """Poses of the keyframes that have one."""
    base = BASE["Pose"]
    for i in keyframes:
        k = view.keyframes[i]
        if (pose := k.pose) is not None:
            properties = (
                f'{{{_keyframe_key(k)}, "map_x": {pose.x_um / UM_PER_M!r},'
                f' "map_y": {pose.y_um / UM_PER_M!r}, "map_yaw": {pose.yaw_rad!r}'
                f"{_floor(k.floor)}}}"
            )
            yield base + i, properties


def observation_rows(view: MapView, observations: Iterable[int]) -> Iterator[VertexRow]:
    """Observations."""
    base, keyframe, key = BASE["Observation"], -1, ""
    for i in observations:
        o = view.observations[i]
        if o.keyframe != keyframe:
            keyframe, key = o.keyframe, _keyframe_key(view.keyframes[o.keyframe])
        x0, y0, x1, y1 = o.bbox
        properties = (
            f'{{"det_id": {text(o.det_id)}, "class_name": {text(o.class_name)},'
            f' "confidence": {o.confidence!r}, "bbox": [{x0!r}, {y0!r}, {x1!r}, {y1!r}], {key}}}'
        )
        yield base + i, properties


def object_rows(view: MapView, objects: Iterable[int]) -> Iterator[VertexRow]:
    """Objects; under fusion by evidence also where they stand, and whether they are missing."""
    base, by_evidence = BASE["Object"], view.settings.fusion == "evidence"
    for i in objects:
        o = view.all_objects[i]
        more = _evidence(o) if by_evidence else ""
        properties = (
            f'{{"object_id": {text(o.object_id)}, "class_name": {text(o.class_name)},'
            f' "mean_x": {o.mean_x!r}, "mean_y": {o.mean_y!r}, "obs_count": {o.obs_count},'
            f' "first_seen": {o.first_seen!r}, "last_seen": {o.last_seen!r}{more}}}'
        )
        yield base + i, properties


def _evidence(found: ObjectRecord) -> str:
    """More properties of an Object; one without an estimate has no position."""
    at, missing = found.estimate, "false" if found.missing_in is None else "true"
    if at is None:
        return f', "missing": {missing}'
    xx, xy, yy = at.covariance_m2
    return (
        f', "est_x": {at.est_x!r}, "est_y": {at.est_y!r}, "est_sigma_m": {at.est_sigma_m!r},'
        f' "est_xx": {xx!r}, "est_xy": {xy!r}, "est_yy": {yy!r}, "est_spots": {at.spots},'
        f' "missing": {missing}'
    )


def place_rows(view: MapView, places: Iterable[int]) -> Iterator[VertexRow]:
    """Places, also those that were absorbed. Only those that have a name, a floor or a type that is
    sure have these properties."""
    base = BASE["Place"]
    for i in places:
        p = view.all_places[i]
        name = "" if p.name is None else f', "name": {text(p.name)}'
        name += _floor(view.floor_of(p.ordinal))
        kind = view.type_of(p.ordinal)
        if kind is not None and kind.type is not None:
            probability = number(kind.probability)
            name += f', "type": {text(kind.type)}, "type_probability": {probability}'
        properties = (
            f'{{"place_id": {text(p.place_id)}, "centroid_x": {number(p.centroid_x)},'
            f' "centroid_y": {number(p.centroid_y)}, "keyframe_count": {p.keyframe_count}{name}}}'
        )
        yield base + i, properties


def has_keyframe_rows(view: MapView, keyframes: Iterable[int]) -> Iterator[EdgeRow]:
    """Edges from runs to keyframes."""
    edge, run, keyframe = BASE["HAS_KEYFRAME"], BASE["Run"], BASE["Keyframe"]
    return ((edge + k, run + view.keyframes[k].run, keyframe + k, _NONE) for k in keyframes)


def has_pose_rows(view: MapView, keyframes: Iterable[int]) -> Iterator[EdgeRow]:
    """Edges from keyframes to poses."""
    edge, keyframe, pose = BASE["HAS_POSE"], BASE["Keyframe"], BASE["Pose"]
    posed = (k for k in keyframes if view.keyframes[k].pose is not None)
    return ((edge + k, keyframe + k, pose + k, _NONE) for k in posed)


def has_observation_rows(view: MapView, observations: Iterable[int]) -> Iterator[EdgeRow]:
    """Edges from keyframes to observations."""
    edge, keyframe, observation = BASE["HAS_OBSERVATION"], BASE["Keyframe"], BASE["Observation"]
    records = view.observations
    return (
        (edge + o, keyframe + records[o].keyframe, observation + o, _NONE) for o in observations
    )


def observes_rows(view: MapView, observations: Iterable[int]) -> Iterator[EdgeRow]:
    """Edges from observations that were fused to their objects."""
    edge, observation, fused = BASE["OBSERVES"], BASE["Observation"], BASE["Object"]
    for i in observations:
        o = view.observations[i]
        if o.object is not None and o.similarity_q40 is not None:
            properties = f'{{"similarity": {o.similarity_q40 / Q40!r}}}'
            yield edge + i, observation + i, fused + o.object, properties


def located_in_rows(view: MapView, objects: Iterable[int]) -> Iterator[EdgeRow]:
    """Edges from objects that are in a place to it."""
    for o in objects:
        place = view.all_objects[o].place
        if place is not None:
            yield BASE["LOCATED_IN"] + o, BASE["Object"] + o, BASE["Place"] + place, _NONE


def in_place_rows(view: MapView, keyframes: Iterable[int]) -> Iterator[EdgeRow]:
    """Edges from keyframes that are in a place to it."""
    for k in keyframes:
        place = view.keyframes[k].place
        if place is not None:
            yield BASE["IN_PLACE"] + k, BASE["Keyframe"] + k, BASE["Place"] + place, _NONE


def adjacent_to_rows(
    view: MapView, links: Iterable[tuple[PlaceOrdinal, PlaceOrdinal]]
) -> Iterator[EdgeRow]:
    """Edges of those pairs of places that have one now."""
    base = graphid_base("ADJACENT_TO")
    for a, b in links:
        shared = view.adjacency.get((a, b))
        if shared is not None:
            mark = ', "between_floors": true' if view.is_between_floors(a, b) else ""
            properties = f'{{"shared_transitions": {shared}{mark}}}'
            edge = base + adjacency_number(a, b)
            yield edge, BASE["Place"] + a, BASE["Place"] + b, properties


def floor_rows(view: MapView, floors: Iterable[int]) -> Iterator[VertexRow]:
    """Floors that have a name."""
    names = list(view.floors)
    return ((BASE["Floor"] + i, f'{{"floor": {text(names[i])}}}') for i in floors)


def building_rows(view: MapView) -> Iterator[VertexRow]:
    """The building, once it has a place or a floor."""
    if view.all_places or view.floors:
        yield BASE["Building"], f'{{"building_id": {text(BUILDING_ID)}}}'


def part_of_rows(
    view: MapView, places: Iterable[PlaceOrdinal], floors: Iterable[int]
) -> Iterator[EdgeRow]:
    """Edges from places to their floor, or to the building where the floor has no name; and from
    floors to the building."""
    base, building = graphid_base("PART_OF"), BASE["Building"]
    for p in places:
        floor = view.floor_of(p)
        whole = building if floor is None else BASE["Floor"] + view.floors[floor]
        yield base + p + 1, BASE["Place"] + p, whole, _NONE
    for f in floors:
        yield base + floor_part_number(f), BASE["Floor"] + f, building, _NONE


def _floor(name: str | None) -> str:
    return "" if name is None else f', "floor": {text(name)}'


def _keyframe_key(keyframe: KeyframeRecord) -> str:
    return f'"run_id": {text(keyframe.run_id)}, "keyframe_id": {keyframe.keyframe_id}'
