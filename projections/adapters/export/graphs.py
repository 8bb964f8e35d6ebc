"""The map as a graph of Places and Objects, in GraphML and in Graphviz' DOT.

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
