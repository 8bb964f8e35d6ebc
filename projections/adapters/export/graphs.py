"""The map as a graph of Places and Objects, in GraphML, in Graphviz' DOT and as a scene graph
of spark_dsg.

A node's ``kind`` and an edge's ``label`` are the labels of the database's graph: Place, Object,
ADJACENT_TO, LOCATED_IN. A node's ``label`` is what viewers show: the name, likely type or id of a
Place, the class of an Object; a Place's ``region`` is a GeoJSON geometry in metres. Node ids are
place_id and object_id; where they are escaped, a backslash is doubled, so that different ids stay
different. A property that is unknown is left out.
"""

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from eventsrc.base.text import visible
from projections.map.place_regions import place_regions
from projections.map.records import body_fields
from projections.map.view import MapView

if TYPE_CHECKING:
    import networkx
import json
import math

from projections.adapters.scene import place_colour
from projections.fold.deltas import PlaceOrdinal

_NOT_IN_XML: Final = re.compile("[^\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def graph_of(view: MapView) -> "networkx.Graph":
    """The graph."""
    import networkx  # here: it takes longer to import than most commands take to run

    graph, regions = networkx.Graph(), place_regions(view)
    for place in view.places.values():
        region = regions.get(place.ordinal)
        kind = view.type_of(place.ordinal)
        typed = kind is not None and kind.type is not None
        graph.add_node(
            place.place_id,
            **_known(
                kind="Place",
                label=place.name or (kind.type if kind is not None else None) or place.place_id,
                name=place.name,
                floor=view.floor_of(place.ordinal),
                type=kind.type if kind is not None and typed else None,
                type_probability=kind.probability if kind is not None and typed else None,
                x=place.centroid_x,
                y=place.centroid_y,
                keyframe_count=place.keyframe_count,
                region=None if region is None else region.geometry_text(),
                area_m2=None if region is None else region.area_m2,
            ),
        )
    for found in view.objects.values():
        x, y = found.spot
        graph.add_node(
            found.object_id,
            **_known(
                kind="Object",
                label=found.class_name,
                class_name=found.class_name,
                x=x,
                y=y,
                sigma_m=None if found.estimate is None else found.estimate.est_sigma_m,
                obs_count=found.obs_count,
                missing=True if found.missing_in is not None else None,
                confirmed=found.confirmed,
                z=body_fields(view.body_of(found)).get("z"),
            ),
        )
        if found.place is not None:
            graph.add_edge(found.object_id, view.place_id(found.place), label="LOCATED_IN")
    for a, b, transitions in view.edges():
        graph.add_edge(
            view.place_id(a), view.place_id(b), label="ADJACENT_TO", shared_transitions=transitions
        )
    return graph


def _known(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def graphml(view: MapView) -> str:
    """GraphML 1.0, for Gephi, yEd, Cytoscape and networkx. Characters that XML cannot hold
    or does not keep (tabs, line breaks) are written as escapes (``\\x1b``), backslashes doubled."""
    import networkx

    graph = graph_of(view)
    ids = {node: _in_xml(node) for node in graph}
    for _, values in graph.nodes(data=True):
        values.update({k: _in_xml(v) for k, v in values.items() if isinstance(v, str)})
    return "\n".join(networkx.generate_graphml(networkx.relabel_nodes(graph, ids))) + "\n"


def _in_xml(text: str) -> str:
    doubled = text.replace("\\", "\\\\")
    return _NOT_IN_XML.sub(lambda found: ascii(found[0])[1:-1], doubled)


def dot(view: MapView) -> str:
    """DOT of Graphviz. ``neato`` keeps each Place at its centroid, a metre as an inch, and arranges
    the Objects around the Place that they are in."""
    graph = graph_of(view)
    lines = [
        "graph semantic_map {",
        "  graph [outputorder=edgesfirst, overlap=true];",  # any other value moves Places too
        "  node [fontsize=10, margin=0.03, width=0, height=0];",
    ]
    lines += [f"  {_id(n)} {_attributes(_node(v))};" for n, v in graph.nodes(data=True)]
    for a, b, values in graph.edges(data=True):
        located = {"style": "dotted", "len": "0.7"}
        adjacent = {"label": f"×{values.get('shared_transitions')}", "style": "bold"}
        shown = adjacent if values["label"] == "ADJACENT_TO" else located
        lines.append(f"  {_id(a)} -- {_id(b)} {_attributes(shown)};")
    return "\n".join([*lines, "}"]) + "\n"


def _node(values: Mapping[str, Any]) -> dict[str, str]:
    at = f"{values['x']:.3f},{values['y']:.3f}"
    text = values["label"]
    if values["kind"] == "Object":
        return {"label": text, "pos": at, "shape": "plaintext"}
    return {"label": text, "pos": f"{at}!", "shape": "box", "style": "filled", "fontsize": "14"}


def _attributes(values: Mapping[str, str]) -> str:
    return "[" + ", ".join(f"{name}={_quoted(value)}" for name, value in values.items()) + "]"


def _id(text: str) -> str:
    return _quoted(text.replace("\\", "\\\\"))


def _quoted(text: str) -> str:
    """A DOT string. A backslash in a label begins an escape sequence, so it is doubled."""
    return '"' + visible(text).replace("\\", "\\\\").replace('"', '\\"') + '"'


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
    """The map in the JSON that `DynamicSceneGraph.load` of spark_dsg reads.

    | layer | is | its parent |
    |---|---|---|
    | rooms | a Place | |
    | places | a keyframe that is in a Place; edges follow the drives | its Place |
    | objects | a confirmed Object | the keyframe of its Place that is nearest to it |

    Rooms have edges where robots went from one to the other. A semantic label is the index of a
    class among the map's classes by name. Ids of the map are in each node's metadata.
    """
    classes = sorted({found.class_name for found in view.objects.values()})
    labels = {name: number for number, name in enumerate(classes)}
    nodes, edges = [], []
    for place in view.places.values():
        kind = view.type_of(place.ordinal)
        name = place.name or (kind.type if kind is not None else None) or place.place_id
        at = [place.centroid_x, place.centroid_y, 0.0]
        known: dict[str, Any] = {"place_id": place.place_id, "floor": view.floor_of(place.ordinal)}
        attributes = _spark_attributes("Room", name, at, known, colour=place.ordinal, **_ROOM)
        nodes.append(_spark_node("R", place.ordinal, _ROOMS, attributes))
    before: dict[int, int] = {}
    for keyframe in sorted(view.keyframes, key=lambda k: (k.run, k.keyframe_id)):
        if keyframe.pose is None or keyframe.place is None:
            continue
        place_id = view.survivors.find(keyframe.place)
        at = [keyframe.pose.x_m, keyframe.pose.y_m, 0.0]
        known = {"run_id": keyframe.run_id, "keyframe_id": keyframe.keyframe_id}
        seen: dict[str, Any] = {**_PLACE, "last_update_time_ns": round(keyframe.timestamp * _NS)}
        attributes = _spark_attributes("Place", "", at, known, colour=place_id, **seen)
        nodes.append(_spark_node("p", keyframe.ordinal, _PLACES, attributes))
        edges.append((_spark_id("R", place_id), _spark_id("p", keyframe.ordinal)))
        if keyframe.run in before:
            edges.append((_spark_id("p", before[keyframe.run]), _spark_id("p", keyframe.ordinal)))
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
        attributes = _spark_attributes(
            "Object", found.class_name, at, known, colour=found.place, **own
        )
        nodes.append(_spark_node("O", found.ordinal, _OBJECTS, attributes))
        near = _nearest(view, found.place, found.spot)
        if near is not None:
            edges.append((_spark_id("p", near), _spark_id("O", found.ordinal)))
    edges += [(_spark_id("R", a), _spark_id("R", b)) for a, b, _ in view.edges()]
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


def _spark_id(category: str, number: int) -> int:
    return ord(category) << 56 | number


def _spark_node(
    category: str, number: int, layer: int, attributes: dict[str, Any]
) -> dict[str, Any]:
    return {
        "id": _spark_id(category, number),
        "layer": layer,
        "partition": 0,
        "attributes": attributes,
    }


def _spark_attributes(
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
