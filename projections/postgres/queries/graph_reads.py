"""Reads of Places and Objects from the graph's tables, in one or two round trips each.

Ids and class names are bind parameters, encoded as agtype strings; they may hold any characters.
"""

import contextlib
import json
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import psycopg

from eventsrc.base.text import advised
from projections.fold.map_errors import ProjectionMissing
from projections.map.naming import ShortIds
from projections.map.phrases import seen_times
from projections.postgres.connection import (
    Connection,
    database_errors,
    describe_target,
    statements,
    tables,
)
from projections.postgres.labels import graphid_base, number_of


def _read_square(connection: Connection, kind: str, x: float, y: float, r: float) -> list[Any]:
    """Properties of the ``places`` or ``objects`` in a square of half-width ``r`` metres."""
    box = {"x0": x - r, "x1": x + r, "y0": y - r, "y1": y + r}
    return [json.loads(row[0]) for row in _rows(connection, f"near_{kind}", **box)]


def _object_document(row: tuple[str, str | None]) -> dict[str, Any]:
    place = {"place_id": None} if row[1] is None else json.loads(row[1])
    document = {**json.loads(row[0]), "place_id": place["place_id"]}
    return document | ({"place_name": place["name"]} if "name" in place else {})


def read_short_ids(connection: Connection) -> ShortIds:
    """The short ids of all Places and Objects."""
    places = [json.loads(properties) for _, properties in _rows(connection, "places")]
    rows = _rows(connection, "objects")
    objects = [json.loads(properties)["object_id"] for _, properties, _ in rows]
    names = [place["name"] for place in places if "name" in place]
    return ShortIds([place["place_id"] for place in places], objects, names)


def _rows(connection: Connection, name: str, **values: Any) -> list[Any]:
    statement = statements("objects")[name].format(**tables())
    with map_errors(connection.info.dsn):
        return connection.execute(statement, values).fetchall()


@contextlib.contextmanager
def map_errors(url: str) -> Iterator[None]:
    """As `database_errors`, and raises ProjectionMissing for a database without a map."""
    with database_errors(url):
        try:
            yield
        except (psycopg.errors.UndefinedTable, psycopg.errors.InvalidSchemaName):
            raise ProjectionMissing(
                f"{describe_target(url)}: nothing has been projected there yet; run"
                f" `{advised('replay')}`"
            ) from None


def places_near(connection: Connection, x: float, y: float, radius: float) -> list[dict[str, Any]]:
    """Places with a centroid within ``radius`` metres, nearest first, with ``distance_m``."""
    found = _read_square(connection, "places", x, y, radius)
    return _nearest(found, ("centroid_x",), ("centroid_y",), "place_id", (x, y), radius)


def objects_near(connection: Connection, x: float, y: float, radius: float) -> list[dict[str, Any]]:
    """Objects within ``radius`` metres, nearest first, with ``distance_m``.

    The distance is to an Object's estimated position, or to its mean position if it has none.
    """
    found = [_with_iso_times(each) for each in _read_square(connection, "objects", x, y, radius)]
    return _nearest(found, ("est_x", "mean_x"), ("est_y", "mean_y"), "object_id", (x, y), radius)


class Page(NamedTuple):
    """A part of a list. ``after`` is the number of the last one here, None if no more come."""

    things: list[dict[str, Any]]
    after: int | None


def places_after(connection: Connection, after: int, most: int) -> Page:
    """At most ``most`` Places with numbers greater than ``after``, in founding order."""
    values = {"after": str(graphid_base("Place") + after), "most": most + 1}
    rows = _rows(connection, "page_of_places", **values)
    return _page([(row[0], json.loads(row[1])) for row in rows], most)


def objects_after(connection: Connection, after: int, most: int) -> Page:
    """At most ``most`` Objects with numbers greater than ``after``, in founding order, each with
    its ``place_id``."""
    values = {"after": str(graphid_base("Object") + after), "most": most + 1}
    rows = _rows(connection, "page_of_objects", **values)
    return _page([(row[0], _with_iso_times(_object_document(row[1:]))) for row in rows], most)


def _with_iso_times(thing: dict[str, Any]) -> dict[str, Any]:
    return thing | seen_times(thing["first_seen"], thing["last_seen"])


def _page(found: list[tuple[str, dict[str, Any]]], most: int) -> Page:
    """``found`` has one more than the page when more come."""
    page = found[:most]
    after = number_of(int(page[-1][0])) if len(found) > most else None
    return Page([thing for _, thing in page], after)


def _nearest(
    found: list[Any],
    x_keys: tuple[str, ...],
    y_keys: tuple[str, ...],
    id_key: str,
    spot: tuple[float, float],
    radius: float,
) -> list[dict[str, Any]]:
    """The things within ``radius`` of ``spot``, nearest first; a thing's position is under the
    first key it has."""

    def distance(thing: dict[str, Any]) -> float:
        at = [next(thing[key] for key in keys if key in thing) for keys in (x_keys, y_keys)]
        return math.hypot(at[0] - spot[0], at[1] - spot[1])

    measured = [{**thing, "distance_m": distance(thing)} for thing in found]
    return sorted(
        (thing for thing in measured if thing["distance_m"] <= radius),
        key=lambda thing: (thing["distance_m"], thing[id_key]),
    )
