"""The rows of the graph as AGE stores them; those that a batch of events adds, changes, removes.

A row has a graphid, the ends of an edge, and properties as agtype text. That is JSON with two
differences that matter: integer and float are different types, and a number is a float exactly when
it is written with a point or an exponent. Python's ``repr`` of a float always has one of the two
and is the shortest text for that float; the server reads it back to the same bits. Strings are
escaped as JSON has it: quote, backslash and control characters. Most floats of a map are written by
``repr`` alone, which is `number` without its check: they are finite, as the envelope refuses
others, and so would the server. Nothing here is query text. The result is a *value*: a bind
parameter or a field of COPY data.

Two kinds of rows. *Fixed* ones are written once, when their event is folded: Keyframe, Pose,
Observation and the edges HAS_KEYFRAME, HAS_POSE, HAS_OBSERVATION, OBSERVES (an observation is fused
by the event that adds it, or never). *Changing* ones can get other values later: Run, Object,
Place, Floor, Building and the edges LOCATED_IN, IN_PLACE, ADJACENT_TO, PART_OF. Where two Objects
may become one, by a correction or under fusion by evidence, OBSERVES is a changing one too.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from json.encoder import encode_basestring
from typing import Final

from eventsrc.envelope.model import StatedCamera
from projections.fold.deltas import PlaceOrdinal
from projections.fold.exact import Q40, UM_PER_M
from projections.map.changes import BatchChanges, FollowedRegions
from projections.map.place_regions import place_regions
from projections.map.records import KeyframeRecord, ObjectRecord, body_fields
from projections.map.view import MapView

from .labels import LABELS, EdgeLabel, Label, adjacency_number, floor_part_number, graphid_base

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
FIXED: Final[tuple[Label, ...]] = (
    "Keyframe",
    "Pose",
    "Observation",
    "HAS_KEYFRAME",
    "HAS_POSE",
    "HAS_OBSERVATION",
    "OBSERVES",
)
CHANGING: Final = tuple(label for label in LABELS if label not in FIXED)


@dataclass(frozen=True, slots=True)
class GraphRows:
    """Rows to insert (never seen before), to upsert, and graphids to delete, by label.

    ``replaced`` are edges to delete and insert again, of labels without upsert. They are deleted by
    their start vertices, so each must be the only edge of its label that starts at its vertex.
    """

    inserted: dict[Label, list[Row]]
    upserted: dict[Label, list[Row]]
    deleted: dict[Label, list[int]]
    replaced: dict[Label, list[Row]]


def fixed_rows(view: MapView, changes: BatchChanges) -> dict[Label, list[Row]]:
    """The rows of new keyframes and observations that can never change again."""
    labels = FIXED[:-1] if _objects_may_merge(view) else FIXED
    return _listed(_rows(view, changes), labels)


def changing_rows(view: MapView) -> dict[Label, list[Row]]:
    """All rows of the map that a later event may change."""
    labels = (*CHANGING, "OBSERVES") if _objects_may_merge(view) else CHANGING
    return _listed(_rows(view, _everything(view)), labels)


def changed_rows(changes: BatchChanges, view: MapView) -> GraphRows:
    """The rows to insert, upsert and delete after a batch."""
    if changes.regions is not None and (moved := changes.regions.changed(view)):
        changes = replace(changes, places=sorted({*changes.places, *moved}))
    rows = _rows(view, changes)
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
    return GraphRows(
        _listed(rows, FIXED),
        _listed(rows, CHANGING),
        {label: ids for label, ids in deleted.items() if ids},
        _listed({"OBSERVES": _observes_rows(view, earlier)}, ("OBSERVES",)),
    )


def expected_rows(view: MapView, label: Label) -> Iterator[Row]:
    """All rows that the table of a label must hold, by graphid."""
    return _rows(view, _everything(view))[label]


def _objects_may_merge(view: MapView) -> bool:
    return view.settings.fusion == "evidence" or bool(view.corrections.same)


def _listed(rows: Mapping[Label, Iterator[Row]], labels: Sequence[Label]) -> dict[Label, list[Row]]:
    """The rows of labels that have some."""
    return {label: found for label in labels if (found := list(rows[label]))}


def _everything(view: MapView) -> BatchChanges:
    """The changes of a batch of all events."""
    objects = sorted(view.objects)
    return BatchChanges(
        keyframes=range(len(view.keyframes)),
        observations=range(len(view.observations)),
        embedded=[],
        runs=[run.ordinal for run in view.runs],
        objects=objects,
        places=sorted(view.places),
        located=objects,
        placed=[k.ordinal for k in view.keyframes],
        links=sorted(view.adjacency),
        reassigned=[],
        formed=[place.ordinal for place in view.all_places],
        floors=range(len(view.floors)),
    )


def _rows(view: MapView, ids: BatchChanges) -> dict[Label, Iterator[Row]]:
    """The rows of these ids by label, each made when it is asked for. Not all ids have one."""
    keyframes, observations, objects = view.keyframes, view.observations, view.all_objects
    return {
        "Run": _run_rows(view, ids.runs),
        "Keyframe": _keyframe_rows(view, ids.keyframes),
        "Pose": _pose_rows(view, ids.keyframes),
        "Observation": _observation_rows(view, ids.observations),
        "Object": object_rows(view, filter(view.objects.__contains__, ids.objects)),
        "Place": _place_rows(view, filter(view.places.__contains__, ids.places), ids.regions),
        "HAS_KEYFRAME": _edges("HAS_KEYFRAME", ((k, keyframes[k].run, k) for k in ids.keyframes)),
        "HAS_POSE": _edges(
            "HAS_POSE", ((k, k, k) for k in ids.keyframes if keyframes[k].pose is not None)
        ),
        "HAS_OBSERVATION": _edges(
            "HAS_OBSERVATION", ((o, observations[o].keyframe, o) for o in ids.observations)
        ),
        "OBSERVES": _observes_rows(view, ids.observations),
        "LOCATED_IN": _edges(
            "LOCATED_IN",
            (
                (o, o, place)
                for o in filter(view.objects.__contains__, ids.located)
                if (place := objects[o].place) is not None
            ),
        ),
        "IN_PLACE": _edges(
            "IN_PLACE",
            ((k, k, place) for k in ids.placed if (place := keyframes[k].place) is not None),
        ),
        "ADJACENT_TO": _adjacent_to_rows(view, ids.links),
        "Floor": _floor_rows(view, ids.floors),
        "Building": _building_rows(bool(ids.formed or ids.floors)),
        "PART_OF": _part_of_rows(view, filter(view.places.__contains__, ids.formed), ids.floors),
    }


_ENDS: Final[dict[EdgeLabel, tuple[Label, Label]]] = {
    "HAS_KEYFRAME": ("Run", "Keyframe"),
    "HAS_POSE": ("Keyframe", "Pose"),
    "HAS_OBSERVATION": ("Keyframe", "Observation"),
    "LOCATED_IN": ("Object", "Place"),
    "IN_PLACE": ("Keyframe", "Place"),
}


def _edges(label: EdgeLabel, ordinals: Iterable[tuple[int, int, int]]) -> Iterator[EdgeRow]:
    """Edges without properties, of the ordinals of edge, start and end."""
    edge, (start, end) = BASE[label], (BASE[each] for each in _ENDS[label])
    return ((edge + i, start + a, end + b, _NONE) for i, a, b in ordinals)


def text(value: str) -> str:
    """A string. It must hold no NUL and no lone surrogate, which PostgreSQL cannot store."""
    return encode_basestring(value)


def number(value: float) -> str:
    """A finite float, -0.0 and 1e22 included; ints are written by ``str``."""
    written = repr(float(value))
    if written[-1] in "fn":  # inf, nan
        raise ValueError(f"{value} is no number a graph can hold")
    return written


def _run_rows(view: MapView, runs: Iterable[int]) -> Iterator[VertexRow]:
    for i in runs:
        run = view.runs[i]
        properties = f'{{"run_id": {text(run.run_id)}, "started_at": {number(run.started_at)}}}'
        yield BASE["Run"] + i, properties


def _keyframe_rows(view: MapView, keyframes: Iterable[int]) -> Iterator[VertexRow]:
    base = BASE["Keyframe"]
    for i in keyframes:
        k = view.keyframes[i]
        more = f'"timestamp": {k.timestamp!r}, "offset": {k.offset}{_camera(k.camera)}'
        if k.frame is not None:
            joined = "true" if k.frame in view.frames else "false"
            more += f', "frame": {text(k.frame)}, "frame_joined": {joined}'
        properties = f"{{{_keyframe_key(k)}, {more}}}"
        yield base + i, properties


def _camera(camera: StatedCamera | None) -> str:
    if camera is None:
        return ""
    fields = (f'"{name}": {getattr(camera, name)!r}' for name in StatedCamera.__struct_fields__)
    return f', "camera": {{{", ".join(fields)}}}'


def _pose_rows(view: MapView, keyframes: Iterable[int]) -> Iterator[VertexRow]:
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


def _observation_rows(view: MapView, observations: Iterable[int]) -> Iterator[VertexRow]:
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
        more = _evidence(view, o) if by_evidence else ""
        measured = body_fields(view.body_of(o))
        more += "".join(f', "{name}": {value!r}' for name, value in measured.items())
        properties = (
            f'{{"object_id": {text(o.object_id)}, "class_name": {text(o.class_name)},'
            f' "mean_x": {o.mean_x!r}, "mean_y": {o.mean_y!r}, "obs_count": {o.obs_count},'
            f' "first_seen": {o.first_seen!r}, "last_seen": {o.last_seen!r},'
            f' "confirmed": {"true" if o.confirmed else "false"}{more}}}'
        )
        yield base + i, properties


def _evidence(view: MapView, found: ObjectRecord) -> str:
    """More properties of an Object; one without an estimate has no position. One that is missing
    has the run in which it is, one that moved where it stood before."""
    at, missing = found.estimate, "false"
    if found.missing_in is not None:
        missing = f'true, "missing_in": {text(view.runs[found.missing_in].run_id)}'
    if found.relocations:
        moved = found.relocations[-1]
        missing += f', "moved_from_x": {number(moved.from_x_um / UM_PER_M)}'
        missing += f', "moved_from_y": {number(moved.from_y_um / UM_PER_M)}'
        missing += f', "moved_at": {moved.offset}'
    if at is None:
        return f', "missing": {missing}'
    xx, xy, yy = at.covariance_m2
    return (
        f', "est_x": {at.est_x!r}, "est_y": {at.est_y!r}, "est_sigma_m": {at.est_sigma_m!r},'
        f' "est_xx": {xx!r}, "est_xy": {xy!r}, "est_yy": {yy!r}, "est_spots": {at.spots},'
        f' "missing": {missing}'
    )


def _place_rows(
    view: MapView, places: Iterable[PlaceOrdinal], followed: FollowedRegions | None
) -> Iterator[VertexRow]:
    """Places, also those that were absorbed. Only those that have a name, a floor, a type that is
    sure or a region have these properties."""
    base, regions = BASE["Place"], place_regions(view) if followed is None else followed.regions
    for i in places:
        p = view.all_places[i]
        name = "" if p.name is None else f', "name": {text(p.name)}'
        name += _floor(view.floor_of(p.ordinal))
        kind = view.type_of(p.ordinal)
        if kind is not None and kind.type is not None:
            probability = number(kind.probability)
            name += f', "type": {text(kind.type)}, "type_probability": {probability}'
        if (region := regions.get(p.ordinal)) is not None:
            geometry = text(region.geometry_text())
            name += f', "region": {geometry}, "area_m2": {number(region.area_m2)}'
        properties = (
            f'{{"place_id": {text(p.place_id)}, "centroid_x": {number(p.centroid_x)},'
            f' "centroid_y": {number(p.centroid_y)}, "keyframe_count": {p.keyframe_count}{name}}}'
        )
        yield base + i, properties


def _observes_rows(view: MapView, observations: Iterable[int]) -> Iterator[EdgeRow]:
    """Edges from observations that were fused to their objects."""
    edge, observation, fused = BASE["OBSERVES"], BASE["Observation"], BASE["Object"]
    for i in observations:
        o = view.observations[i]
        if o.object is not None:
            q40 = o.similarity_q40
            properties = _NONE if q40 is None else f'{{"similarity": {q40 / Q40!r}}}'
            yield edge + i, observation + i, fused + o.object, properties


def _adjacent_to_rows(
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


def _floor_rows(view: MapView, floors: Iterable[int]) -> Iterator[VertexRow]:
    """Floors that have a name."""
    names = list(view.floors)
    return ((BASE["Floor"] + i, f'{{"floor": {text(names[i])}}}') for i in floors)


def _building_rows(exists: bool) -> Iterator[VertexRow]:
    """The building, once it has a place or a floor."""
    if exists:
        yield BASE["Building"], f'{{"building_id": {text(BUILDING_ID)}}}'


def _part_of_rows(
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
