"""The table ``mapfold.occupancy_map``: the occupancy map in force on each floor that has one.

It is part of the graph's sink: a rebuild and a tail replace its rows in the transaction that moves
the graph's checkpoint. There are as many rows as floors with a map, so all are replaced whenever
one of them changes; readers see the old ones or the new ones.

The checkpoint has a key of the rows, so that readers read the maps again only when the key changed.
"""

import hashlib
import json
from collections.abc import Sequence
from typing import NamedTuple

from eventsrc.base.text import advised
from eventsrc.envelope.grey_images import BadImage, decode_grey_png, encode_png
from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.map_errors import DatabaseError, ProjectionMismatch
from projections.map.view import MapView

from .connection import Connection, describe_connection, statements
from .labels import MAP_TABLE
from .replaced_tables import copy_table_privileges


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


def refuse_missing(connection: Connection) -> None:
    """Raise ProjectionMismatch where there is a graph without the table."""
    if not _exists(connection):
        raise ProjectionMismatch(
            f"{describe_connection(connection)}: the graph there has no table mapfold.{MAP_TABLE}:"
            " an older mapfold made it, or somebody dropped the table; run"
            f" `{advised('replay')}`, which makes it again"
        )


def ensure(connection: Connection) -> None:
    """Create the table if it is missing, open to the roles of the checkpoints."""
    if not _exists(connection):
        connection.execute(statements("occupancy_map")["create"])
        copy_table_privileges(connection, "mapfold", "checkpoint", MAP_TABLE)


def replace(connection: Connection, rows: Sequence[MapRow]) -> None:
    """Replace all rows by these."""
    connection.execute(statements("occupancy_map")["clear"])
    for row in rows:
        connection.execute(statements("occupancy_map")["insert"], row)


def read(connection: Connection) -> list[MapRow]:
    """The rows, by offset."""
    return [MapRow(*row) for row in connection.execute(statements("occupancy_map")["rows"])]


def read_with_key(connection: Connection) -> tuple[str | None, dict[str | None, OccupancyMap]]:
    """The maps by floor, and their `maps_key`.

    Raises DatabaseError for a row that mapfold has not written.
    """
    found = connection.execute(statements("occupancy_map")["with_key"]).fetchall()
    rows = [MapRow(*columns) for _, *columns in found if columns[0] is not None]
    maps = {row.floor: _map_of(connection, row) for row in rows}
    return (found[0][0] if found else None), maps


def _map_of(connection: Connection, row: MapRow) -> OccupancyMap:
    try:
        return map_of(row)
    except BadImage as error:
        raise DatabaseError(
            f"{describe_connection(connection)}: mapfold.{MAP_TABLE} at log_offset"
            f" {row.log_offset}: png: {error}; run `{advised('replay')}`, which writes it again"
        ) from None


def _exists(connection: Connection) -> bool:
    row = connection.execute(statements("occupancy_map")["exists"]).fetchone()
    return row is not None and bool(row[0])
