"""A map in the formats of other programs: GraphML, Graphviz, GeoJSON, CSV, Nav2 waypoints.

Each function takes a `MapView` and returns the text of a file; the same view gives the same bytes.
"""

from .geojson import Origin, Point, geojson, hull
from .graphs import dot, graphml
from .tables import tables
from .waypoints import nav2_waypoints

__all__ = ["Origin", "Point", "dot", "geojson", "graphml", "hull", "nav2_waypoints", "tables"]
