"""Reads of Places and Objects from the graph's tables, in one or two round trips each.

Ids and class names are bind parameters, encoded as agtype strings; they may hold any characters.
"""

import json
import math
from typing import Any, NamedTuple

import psycopg

from eventsrc.base.advised import advised
from projections.fold.errors import ProjectionMissing
from projections.postgres.connection import Connection, database_errors, describe_connection
from projections.postgres.graph_render import text
from projections.postgres.labels import graphid_base
from projections.postgres.statements import statements, tables

from .place_graph import PlaceGraph, PlaceNode

_NUMBER_MASK = (1 << 48) - 1


def read_place_graph(connection: Connection) -> PlaceGraph:
    """All Places and their adjacency."""
    nodes = []
    for graphid, properties in _rows(connection, "places"):
        place = json.loads(properties)
        nodes.append(
            PlaceNode(
                _ordinal(graphid),
                place["place_id"],
                place["centroid_x"],
                place["centroid_y"],
                place["keyframe_count"],
                place.get("name"),
                place.get("type"),
                place.get("type_probability"),
            )
        )
    edges = [
        (_ordinal(a), _ordinal(b), json.loads(properties)["shared_transitions"])
        for a, b, properties in _rows(connection, "edges")
    ]
    return PlaceGraph(nodes, edges)


def read_object(connection: Connection, object_id: str) -> dict[str, Any] | None:
    """An Object with its ``place_id`` (None for none); None if there is no such Object.

    ``place_name`` is there if the Place has a name.
    """
    rows = _rows(connection, "object", id=text(object_id))
    return _object_document(rows[0]) if rows else None


def read_objects_of_place(connection: Connection, place_id: str) -> list[dict[str, Any]]:
    """The Objects located in a Place, in founding order."""
    return [
        _object_document(row) for row in _rows(connection, "objects_of_place", id=text(place_id))
    ]


def read_object_counts(connection: Connection, class_name: str) -> dict[int, int]:
    """Number of Objects of a class, by Place ordinal; only Places that have one."""
    rows = _rows(connection, "object_counts", id=text(class_name))
    return {_ordinal(graphid): count for graphid, count in rows}


def _read_square(connection: Connection, kind: str, x: float, y: float, r: float) -> list[Any]:
    """Properties of the ``places`` or ``objects`` in a square of half-width ``r`` metres."""
    box = {"x0": x - r, "x1": x + r, "y0": y - r, "y1": y + r}
    return [json.loads(row[0]) for row in _rows(connection, f"near_{kind}", **box)]


def _object_document(row: tuple[str, str | None]) -> dict[str, Any]:
    place = {"place_id": None} if row[1] is None else json.loads(row[1])
    document = {**json.loads(row[0]), "place_id": place["place_id"]}
    return document | ({"place_name": place["name"]} if "name" in place else {})


def _ordinal(graphid: str) -> int:
    return (int(graphid) & _NUMBER_MASK) - 1


def _rows(connection: Connection, name: str, **values: Any) -> list[Any]:
    statement = statements("objects")[name].format(**tables())
    with database_errors(connection.info.dsn):
        try:
            return connection.execute(statement, values).fetchall()
        except (psycopg.errors.UndefinedTable, psycopg.errors.InvalidSchemaName):
            raise ProjectionMissing(
                f"{describe_connection(connection)}: nothing has been projected there yet; run"
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
    found = _read_square(connection, "objects", x, y, radius)
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
    return _page([(row[0], _object_document(row[1:])) for row in rows], most)


def _page(found: list[tuple[str, dict[str, Any]]], most: int) -> Page:
    """``found`` has one more than the page when more come."""
    page = found[:most]
    after = int(page[-1][0]) & _NUMBER_MASK if len(found) > most else None
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
