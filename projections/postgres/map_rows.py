"""Rows of ``mapfold.occupancy_map``, computed from the view."""

import hashlib
import json
from typing import NamedTuple

from eventsrc.envelope.grey_images import decode_grey_png, encode_png
from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.map.view import MapView


class MapRow(NamedTuple):
    """A row, in the order of the columns."""

    log_offset: Offset
    floor: str | None
    map_id: str | None
    source: str
    resolution: float
    origin_x: float
    origin_y: float
    origin_yaw: float
    width: int
    height: int
    png: bytes
    digest: str


def map_rows(view: MapView) -> list[MapRow]:
    """The rows that a view has, by offset."""
    return [
        MapRow(
            given.offset,
            floor,
            given.map.map_id,
            given.map.source,
            given.map.resolution,
            *given.map.origin,
            given.map.width,
            given.map.height,
            encode_png(given.map.cells[::-1]),
            given.map.digest(),
        )
        for floor, given in view.maps_in_force().items()
    ]


def maps_key(view: MapView) -> str | None:
    """SHA-256 of the maps in force, by floor; None without any."""
    maps = [(floor, given.map.digest()) for floor, given in view.maps_in_force().items()]
    return hashlib.sha256(json.dumps(maps).encode()).hexdigest() if maps else None


def map_of(row: MapRow) -> OccupancyMap:
    """The map of a row. Raises BadImage."""
    cells = decode_grey_png(bytes(row.png), row.width, row.height)[::-1]
    origin = row.origin_x, row.origin_y, row.origin_yaw
    return OccupancyMap(row.map_id, row.resolution, origin, row.source, cells, row.floor)
