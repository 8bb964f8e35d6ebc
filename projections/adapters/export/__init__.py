"""A map in the formats of other programs: GraphML, Graphviz, GeoJSON, CSV, Nav2 waypoints.

Each function takes a `MapView` and returns the text of a file; the same view gives the same bytes.
"""

from .geojson import Origin, geojson
from .graphs import dot, graphml
from .lists import nav2_waypoints, tables

__all__ = ["Origin", "dot", "geojson", "graphml", "nav2_waypoints", "tables"]
