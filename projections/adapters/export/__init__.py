"""A map in the formats of other programs: GraphML, Graphviz, GeoJSON, CSV, Nav2 waypoints,
spark_dsg.

Each function takes a `MapView` and returns the text of a file; the same view gives the same bytes.
"""

from .graphs import dot, graphml, spark_dsg
from .lists import Origin, geojson, nav2_waypoints, tables

__all__ = ["Origin", "dot", "geojson", "graphml", "nav2_waypoints", "spark_dsg", "tables"]
