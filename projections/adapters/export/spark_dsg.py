"""The map as a scene graph of spark_dsg, in the JSON that its `DynamicSceneGraph.load` reads.

| layer | is | its parent |
|---|---|---|
| rooms | a Place | |
| places | a keyframe that is in a Place; edges follow the drives | its Place |
| objects | a confirmed Object | the keyframe of its Place that is nearest to it |

Rooms have edges where robots went from one to the other. A semantic label is the index of a class
among the map's classes by name. Ids of the map are in each node's metadata.
"""

import json
import math
from typing import Any, Final

from projections.adapters.palette import place_colour
from projections.fold.deltas import PlaceOrdinal
from projections.map.records import body_fields
from projections.map.view import MapView

_OBJECTS, _PLACES, _ROOMS = 2, 3, 4
_LAYERS: Final = {
    "AGENTS": 2,
    "OBJECTS": _OBJECTS,
    "PLACES": _PLACES,
    "ROOMS": _ROOMS,
    "BUILDINGS": 5,
}
_VERSION: Final = {"major": 1, "minor": 1, "patch": 3}
"""Of spark_dsg, whose form this is."""
_UNKNOWN: Final = 2**32 - 1
_LEVEL: Final = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
_NS: Final = 1_000_000_000


def spark_dsg(view: MapView) -> str:
    """The text of the file."""
    classes = sorted({found.class_name for found in view.objects.values()})
    labels = {name: number for number, name in enumerate(classes)}
    nodes, edges = [], []
    for place in view.places.values():
        kind = view.type_of(place.ordinal)
        name = place.name or (kind.type if kind is not None else None) or place.place_id
        at = [place.centroid_x, place.centroid_y, 0.0]
        known: dict[str, Any] = {"place_id": place.place_id, "floor": view.floor_of(place.ordinal)}
        attributes = _attributes("Room", name, at, known, colour=place.ordinal, **_ROOM)
        nodes.append(_node("R", place.ordinal, _ROOMS, attributes))
    before: dict[int, int] = {}
    for keyframe in sorted(view.keyframes, key=lambda k: (k.run, k.keyframe_id)):
        if keyframe.pose is None or keyframe.place is None:
            continue
        place_id = view.survivors.find(keyframe.place)
        at = [keyframe.pose.x_m, keyframe.pose.y_m, 0.0]
        known = {"run_id": keyframe.run_id, "keyframe_id": keyframe.keyframe_id}
        seen: dict[str, Any] = {**_PLACE, "last_update_time_ns": round(keyframe.timestamp * _NS)}
        attributes = _attributes("Place", "", at, known, colour=place_id, **seen)
        nodes.append(_node("p", keyframe.ordinal, _PLACES, attributes))
        edges.append((_id("R", place_id), _id("p", keyframe.ordinal)))
        if keyframe.run in before:
            edges.append((_id("p", before[keyframe.run]), _id("p", keyframe.ordinal)))
        before[keyframe.run] = keyframe.ordinal
    for found in view.objects.values():
        if not found.confirmed:
            continue
        body = body_fields(view.body_of(found))
        at = [*found.spot, body.get("z", 0.0)]
        known = {
            "object_id": found.object_id,
            "obs_count": found.obs_count,
            "missing": found.missing_in is not None,
        }
        own: dict[str, Any] = {**_OBJECT, "last_update_time_ns": round(found.last_seen * _NS)}
        own["semantic_label"] = labels[found.class_name]
        if "size" in body:
            own["bounding_box"] = _box(at, body["size"])
        attributes = _attributes("Object", found.class_name, at, known, colour=found.place, **own)
        nodes.append(_node("O", found.ordinal, _OBJECTS, attributes))
        near = _nearest(view, found.place, found.spot)
        if near is not None:
            edges.append((_id("p", near), _id("O", found.ordinal)))
    edges += [(_id("R", a), _id("R", b)) for a, b, _ in view.edges()]
    keys = {name: {"layer": layer, "partition": 0} for name, layer in _LAYERS.items()}
    document = {
        "SPARK_DSG_header": {"project_name": "main", "version": _VERSION},
        "directed": False,
        "multigraph": False,
        "metadata": {"labels": labels},
        "layer_keys": [keys[name] for name in ("OBJECTS", "PLACES", "ROOMS", "BUILDINGS")],
        "layer_names": keys,
        "nodes": nodes,
        "edges": [{"info": _EDGE, "source": a, "target": b} for a, b in edges],
    }
    return json.dumps(document, ensure_ascii=False) + "\n"


def _nearest(view: MapView, place: PlaceOrdinal | None, spot: tuple[float, float]) -> int | None:
    """The keyframe of an Object's Place that is nearest to it."""
    members = view.places[place].members if place is not None else ()
    poses = ((k, view.keyframes[k].pose) for k in members)
    ways = [(math.dist(spot, (pose.x_m, pose.y_m)), k) for k, pose in poses if pose is not None]
    return min(ways)[1] if ways else None


def _id(category: str, number: int) -> int:
    return ord(category) << 56 | number


def _node(category: str, number: int, layer: int, attributes: dict[str, Any]) -> dict[str, Any]:
    return {
        "id": _id(category, number),
        "layer": layer,
        "partition": 0,
        "attributes": attributes,
    }


def _attributes(
    kind: str,
    name: str,
    position: list[float],
    known: dict[str, Any],
    *,
    colour: int | None,
    **own: Any,
) -> dict[str, Any]:
    text = "#7f7f7f" if colour is None else place_colour(colour)
    red, green, blue = (int(text[i : i + 2], 16) for i in (1, 3, 5))
    return {
        "type": f"{kind}NodeAttributes",
        "name": name,
        "position": position,
        "color": {"r": red, "g": green, "b": blue, "a": 255},
        "bounding_box": _box([0.0, 0.0, 0.0], None),
        "semantic_label": _UNKNOWN,
        "semantic_feature": {"cols": 0, "data": None, "rows": 0},
        "last_update_time_ns": 0,
        "is_active": False,
        "is_predicted": False,
        "metadata": {key: value for key, value in known.items() if value is not None},
        **own,
    }


def _box(position: list[float], size: list[float] | None) -> dict[str, Any]:
    return {
        "type": "INVALID" if size is None else "AABB",
        "dimensions": size or [0.0, 0.0, 0.0],
        "world_P_center": position,
        "world_R_center": _LEVEL,
    }


_ROOM: Final[dict[str, Any]] = {"semantic_class_probabilities": {}}
_OBJECT: Final[dict[str, Any]] = {
    "mesh_connections": [],
    "registered": False,
    "world_R_object": _LEVEL,
}
_PLACE: Final[dict[str, Any]] = {
    "active_frontier": False,
    "anti_frontier": False,
    "deformation_connections": [],
    "distance": 0.0,
    "frontier_scale": [0.0, 0.0, 0.0],
    "mesh_vertex_labels": [],
    "need_cleanup": False,
    "num_basis_points": 0,
    "num_frontier_voxels": 0,
    "orientation": _LEVEL,
    "pcl_mesh_connections": [],
    "real_place": True,
    "voxblox_mesh_connections": [],
}
_EDGE: Final = {"metadata": {}, "type": "EdgeAttributes", "weight": 1.0, "weighted": False}
