"""Places and Objects near a position, nearest first."""

import math
from typing import Any

from projections.postgres.connect import Connection

from .graph_reads import read_near


def places_near(connection: Connection, x: float, y: float, radius: float) -> list[dict[str, Any]]:
    """Places whose centroid is within ``radius`` metres, with ``distance_m``."""
    found = read_near(connection, "places", x, y, radius)
    return _nearest(found, "centroid_x", "centroid_y", "place_id", x, y, radius)


def objects_near(connection: Connection, x: float, y: float, radius: float) -> list[dict[str, Any]]:
    """Objects seen from within ``radius`` metres on average, with ``distance_m``."""
    found = read_near(connection, "objects", x, y, radius)
    return _nearest(found, "mean_x", "mean_y", "object_id", x, y, radius)


def _nearest(
    found: list[Any], x_key: str, y_key: str, id_key: str, x: float, y: float, radius: float
) -> list[dict[str, Any]]:
    measured = [
        {**thing, "distance_m": math.hypot(thing[x_key] - x, thing[y_key] - y)} for thing in found
    ]
    return sorted(
        (thing for thing in measured if thing["distance_m"] <= radius),
        key=lambda thing: (thing["distance_m"], thing[id_key]),
    )
