"""Queries of the map for `mapfold query`, as documents for JSON: of the live databases or a fold.

A `MapSource` has the data they need: `LiveMap` in the graph's database, `FoldedMap` in a view; both
have the same methods.
"""

from collections.abc import Sequence
from typing import Any, Final, TypeAlias

from projections.fold.place_types import type_of_name
from projections.localize.relocalize import CandidatePlace, MapCandidates, QuestionCrop
from projections.map.naming import Rule, Thing, matches, no_such_thing, thing_called
from projections.map.records import ObjectRecord
from projections.map.view import MapView
from projections.postgres.connection import Connection

from .graph_reads import (
    PlaceGraph,
    PlaceNode,
    read_object,
    read_object_counts,
    read_objects,
    read_objects_of_place,
    read_place_graph,
)

_RECORD_FIELDS: Final = (
    "object_id",
    "class_name",
    "mean_x",
    "mean_y",
    "obs_count",
    "first_seen",
    "last_seen",
    "confirmed",
)
_ESTIMATE_FIELDS: Final = ("est_x", "est_y", "est_sigma_m")
_OBJECT_FIELDS: Final = (
    *_RECORD_FIELDS,
    *_ESTIMATE_FIELDS,
    "missing",
    "place_id",
    "place_name",
)
"""The fields of an Object in the order of the documents; agtype has its own order. Only an Object
in a Place that has a name has the last one; only fusion by evidence gives the estimate and
``missing``."""


class LiveMap:
    """The graph's database; ``connection`` was set up by `prepare_graph`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def place_graph(self) -> PlaceGraph:
        """All Places and their adjacency."""
        return read_place_graph(self._connection)

    def count_objects(self, class_name: str) -> dict[int, tuple[int, int]]:
        """Number of Objects of a class, and of confirmed ones, by Place ordinal; only Places that
        have one."""
        return read_object_counts(self._connection, class_name)

    def find_object(self, object_id: str) -> dict[str, Any] | None:
        """An Object with its place_id."""
        found = read_object(self._connection, object_id)
        return None if found is None else _ordered(found)

    def all_objects(self) -> list[dict[str, Any]]:
        """All Objects, each with its place_id."""
        return [_ordered(thing) for thing in read_objects(self._connection)]

    def objects_in(self, place_id: str) -> list[dict[str, Any]]:
        """The Objects of a Place."""
        return [_ordered(thing) for thing in read_objects_of_place(self._connection, place_id)]


class FoldedMap:
    """A folded map, with the methods of `LiveMap`."""

    def __init__(self, view: MapView) -> None:
        self._view = view

    def place_graph(self) -> PlaceGraph:
        """All Places and their adjacency."""
        return PlaceGraph.of_view(self._view)

    def count_objects(self, class_name: str) -> dict[int, tuple[int, int]]:
        """Number of Objects of a class, and of confirmed ones, by Place ordinal; only Places that
        have one."""
        found: dict[int, tuple[int, int]] = {}
        for each in self._view.objects.values():
            if each.class_name == class_name and each.place is not None:
                count, confirmed = found.get(each.place, (0, 0))
                found[each.place] = count + 1, confirmed + each.confirmed
        return found

    def find_object(self, object_id: str) -> dict[str, Any] | None:
        """An Object with its place_id."""
        objects = self._view.objects.values()
        return next((self._document(o) for o in objects if o.object_id == object_id), None)

    def all_objects(self) -> list[dict[str, Any]]:
        """All Objects, each with its place_id."""
        return [self._document(each) for each in self._view.objects.values()]

    def objects_in(self, place_id: str) -> list[dict[str, Any]]:
        """The Objects of a Place."""
        view = self._view
        return [
            self._document(o) for o in view.objects.values() if view.place_id(o.place) == place_id
        ]

    def _document(self, thing: ObjectRecord) -> dict[str, Any]:
        view, at = self._view, thing.estimate
        by_evidence = view.settings.fusion == "evidence"
        place_name = None if thing.place is None else view.all_places[thing.place].name
        return {
            **{name: getattr(thing, name) for name in _RECORD_FIELDS},
            **{name: getattr(at, name) for name in _ESTIMATE_FIELDS if by_evidence and at},
            **({"missing": thing.missing_in is not None} if by_evidence else {}),
            "place_id": view.place_id(thing.place),
            **({} if place_name is None else {"place_name": place_name}),
        }


MapSource: TypeAlias = LiveMap | FoldedMap


def _ordered(thing: dict[str, Any]) -> dict[str, Any]:
    return {name: thing[name] for name in _OBJECT_FIELDS if name in thing}


def _named(place: PlaceNode | CandidatePlace | None, key: str = "name") -> dict[str, str]:
    """A Place's name under ``key``, nothing if it has none."""
    return {} if place is None or place.name is None else {key: place.name}


def where_is(source: MapSource, wanted: str) -> dict[str, Any] | list[dict[str, Any]]:
    """The Object that ``wanted`` names and the Place it is located in, the Objects of a class, or
    the Places that are of a type or have a name, likeliest first. Raises NoSuchThing, and
    SeveralThings for a short id."""
    thing = source.find_object(wanted)
    if thing is not None:
        return thing
    graph = source.place_graph()
    places = graph.things()
    rule, meant = matches(wanted, places)
    if rule is Rule.ID or rule is Rule.SHORT:
        return [_place(graph.places[graph.find(wanted)])]
    if rule is None:
        objects = source.all_objects()
        things = [_thing(number, each) for number, each in enumerate(objects)]
        rule, meant = matches(wanted, things)
        if rule is Rule.CLASS and len(meant) > 1:
            return [objects[each.ordinal] for each in meant]
        if meant:
            return objects[thing_called(wanted, things, ("object",)).ordinal]
        if type_of_name(wanted) not in {each.word for each in places} - {None}:
            raise no_such_thing(wanted, [*places, *things], ("place", "object"))
    called = {each.ordinal for each in meant if rule is Rule.NAME}
    kind = type_of_name(wanted)
    found = [p for p in graph.places.values() if p.ordinal in called or (kind and p.type == kind)]
    found.sort(key=lambda p: (p.ordinal not in called, -(p.type_probability or 0.0), p.ordinal))
    return [_place(p) for p in found]


def _place(p: PlaceNode) -> dict[str, Any]:
    kind = {} if p.type is None else {"type": p.type, "type_probability": p.type_probability}
    return {"place_id": p.place_id, "centroid_x": p.x, "centroid_y": p.y} | kind | _named(p)


def _thing(number: int, document: dict[str, Any]) -> Thing:
    """An Object of a document, by what it may be called."""
    x, y = (document.get(f"est_{axis}", document[f"mean_{axis}"]) for axis in "xy")
    return Thing(
        "object",
        number,
        document["object_id"],
        document["class_name"],
        count=document["obs_count"],
        spot=(x, y),
        place=document["place_id"],
    )


def objects_of(source: MapSource, place: str) -> list[dict[str, Any]]:
    """The Objects of the Place that ``place`` names. Raises NoSuchThing and SeveralThings."""
    graph = source.place_graph()
    return source.objects_in(graph.places[graph.find(place)].place_id)


def places_holding(
    source: MapSource, class_name: str, start: str, hops: int
) -> list[dict[str, Any]]:
    """Places within ``hops`` steps of ``start`` with an Object of a class, nearest first."""
    graph = source.place_graph()
    within = graph.hops_from(graph.find(start), hops)
    counts = source.count_objects(class_name)
    order = sorted((p for p in within if p in counts), key=lambda p: (within[p], p))
    return [
        {
            "place_id": graph.places[p].place_id,
            "hops": within[p],
            "objects": counts[p][0],
            "confirmed": counts[p][1],
        }
        | _named(graph.places[p])
        for p in order
    ]


def path_between(source: MapSource, start: str, goal: str) -> list[dict[str, Any]]:
    """The Places on the shortest path, both ends included; empty if there is no path."""
    graph = source.place_graph()
    way = graph.path(graph.find(start), graph.find(goal)) or []
    return [
        {
            "place_id": graph.places[p].place_id,
            "centroid_x": graph.places[p].x,
            "centroid_y": graph.places[p].y,
            "shared_transitions": None if i == 0 else graph.shared(way[i - 1], p),
        }
        | _named(graph.places[p])
        for i, p in enumerate(way)
    ]


def similar_objects(
    crops: Sequence[QuestionCrop], candidates: MapCandidates, top: int
) -> list[dict[str, Any]]:
    """Objects most like any of the crops, by their most similar observation."""
    best: dict[str, dict[str, Any]] = {}
    for row in candidates.matches[: len(crops)]:
        for match in row:
            if match.object_id is None:
                continue
            earlier = best.get(match.object_id)
            if earlier is None or match.similarity > earlier["similarity"]:
                place = (
                    None if match.object_place is None else candidates.places[match.object_place]
                )
                best[match.object_id] = {
                    "object_id": match.object_id,
                    "class_name": match.class_name,
                    "similarity": match.similarity,
                    "det_id": match.det_id,
                    "place_id": None if place is None else place.place_id,
                } | _named(place, "place_name")
    ordered = sorted(best.values(), key=lambda o: (-o["similarity"], o["object_id"]))
    return ordered[:top]
