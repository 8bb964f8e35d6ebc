"""A map in the formats of other programs: GraphML, Graphviz, GeoJSON, CSV, Nav2 waypoints,
spark_dsg.

Each function takes a `MapView` and returns the text of a file; the same view gives the same bytes.
"""

from .geojson import Origin, geojson
from .graphs import dot, graphml
from .lists import nav2_waypoints, tables
from .spark_dsg import spark_dsg

__all__ = ["Origin", "dot", "geojson", "graphml", "nav2_waypoints", "spark_dsg", "tables"]
