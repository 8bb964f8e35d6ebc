"""Reads of Places and Objects from the graph's tables, in one or two round trips each.

Ids and class names are bind parameters, encoded as agtype strings; they may hold any characters.
"""

import contextlib
import json
import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import psycopg

from eventsrc.base.text import advised
from projections.fold.map_errors import ProjectionMissing
from projections.map.naming import ShortIds, Thing, thing_called
from projections.map.phrases import seen_times
from projections.map.view import MapView
from projections.postgres.connection import Connection, database_errors, describe_target
from projections.postgres.graph_rows import text
from projections.postgres.labels import graphid_base, number_of
from projections.postgres.statements import statements, tables


@dataclass(frozen=True, slots=True)
class PlaceNode:
    """A Place; ``ordinal`` is its founding order, the centroid is in metres. ``name`` is None where
    it has no name, ``type`` where it is not sure what kind of room it is."""

    ordinal: int
    place_id: str
    x: float
    y: float
    keyframe_count: int
    name: str | None = None
    type: str | None = None
    type_probability: float | None = None


class PlaceGraph:
    """Places by id, and undirected edges with their shared transitions."""

    def __init__(self, places: Iterable[PlaceNode], edges: Iterable[tuple[int, int, int]]) -> None:
        self.places: Mapping[int, PlaceNode] = {p.ordinal: p for p in places}
        self._next: dict[int, dict[int, int]] = {ordinal: {} for ordinal in self.places}
        for a, b, shared in edges:
            self._next[a][b] = self._next[b][a] = shared

    @classmethod
    def of_view(cls, view: MapView) -> "PlaceGraph":
        """The graph of a folded map."""
        nodes = []
        for p in view.places.values():
            node = PlaceNode(
                p.ordinal, p.place_id, p.centroid_x, p.centroid_y, p.keyframe_count, p.name
            )
            kind = view.type_of(p.ordinal)
            if kind is not None and kind.type is not None:
                node = replace(node, type=kind.type, type_probability=kind.probability)
            nodes.append(node)
        return cls(nodes, view.edges())

    def things(self) -> list[Thing]:
        """The Places, by what they may be called."""
        return [
            Thing(
                "place",
                p.ordinal,
                p.place_id,
                p.type,
                p.name,
                count=p.keyframe_count,
                spot=(p.x, p.y),
            )
            for p in self.places.values()
        ]

    def find(self, text: str) -> int:
        """The ordinal of the Place that ``text`` names. Raises NoSuchThing and SeveralThings."""
        return thing_called(text, self.things(), ("place",)).ordinal

    def hops_from(self, start: int, most: int) -> dict[int, int]:
        """Places within ``most`` steps of ``start`` (itself: 0), with their number of steps."""
        hops, waiting = {start: 0}, deque([start])
        while waiting:
            here = waiting.popleft()
            for neighbour in sorted(self._next[here]):
                if neighbour not in hops and hops[here] < most:
                    hops[neighbour] = hops[here] + 1
                    waiting.append(neighbour)
        return hops

    def path(self, start: int, goal: int) -> list[int] | None:
        """The path with the fewest steps, as ordinals; None if there is none.

        Of several, the one whose least driven step has the most transitions; then the one with the
        lowest ordinals.
        """
        steps = self.hops_from(goal, len(self.places))
        if start not in steps:
            return None
        # From the goal outwards, of each place: transitions of the least driven step, and path.
        best: dict[int, tuple[int, list[int]]] = {goal: (1 << 62, [goal])}
        for here in sorted(steps, key=lambda place: (steps[place], place)):
            if here == goal:
                continue
            ways = [
                (min(shared, best[n][0]), [here, *best[n][1]])
                for n, shared in self._next[here].items()
                if steps[n] == steps[here] - 1
            ]
            best[here] = min(ways, key=lambda way: (-way[0], way[1]))
        return best[start][1]

    def shared(self, a: int, b: int) -> int:
        """Shared transitions of two neighbours, 0 if they are none."""
        return self._next[a].get(b, 0)


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


def read_objects(connection: Connection) -> list[dict[str, Any]]:
    """All Objects, each with its ``place_id``, in founding order."""
    return [_object_document(row) for row in _rows(connection, "objects")]


def read_objects_of_place(connection: Connection, place_id: str) -> list[dict[str, Any]]:
    """The Objects located in a Place, in founding order."""
    return [
        _object_document(row) for row in _rows(connection, "objects_of_place", id=text(place_id))
    ]


def read_object_counts(connection: Connection, class_name: str) -> dict[int, tuple[int, int]]:
    """Number of Objects of a class, and of confirmed ones, by Place ordinal; only Places that have
    one."""
    rows = _rows(connection, "object_counts", id=text(class_name))
    return {_ordinal(graphid): (count, confirmed) for graphid, count, confirmed in rows}


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
    objects = [
        json.loads(properties)["object_id"] for properties, _ in _rows(connection, "objects")
    ]
    names = [place["name"] for place in places if "name" in place]
    return ShortIds([place["place_id"] for place in places], objects, names)


def _ordinal(graphid: str) -> int:
    return number_of(int(graphid)) - 1


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
