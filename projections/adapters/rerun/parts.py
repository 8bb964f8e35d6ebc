"""A map as what Rerun shows: points, lines, an arrow and a graph, each at the path of its entity.

| path | what |
|---|---|
| ``map/walls`` | the outline of an occupancy map's walls |
| ``map/regions`` | each Place's region, or the hull of its poses |
| ``map/places`` | the centroid of each, with its name |
| ``map/objects`` | Objects where they stand, with their class |
| ``map/ways`` | adjacency, from centroid to centroid |
| ``map/keyframes``, ``map/path/RUN`` | poses in the colours of their Places, and each run's path |
| ``map/robot`` | the robot at the latest keyframe with a pose |
| ``graph`` | Places and Objects as nodes, ADJACENT_TO and LOCATED_IN as edges |

Entities of a named floor are below ``floors/NAME`` instead of ``map``.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from projections.adapters import scene
from projections.fold.deltas import PlaceOrdinal
from projections.map.place_regions import wall_segments
from projections.map.records import KeyframeRecord
from projections.map.view import MapView

Path = tuple[str, ...]
"""The path of an entity: its parts, not escaped."""
_MISSING: Final = "#d91a26"
_GRAPH_PX_PER_M: Final = 110.0
_RING_PX: Final = 62.0
"""In the graph Objects are in a spiral around their Place, the n-th √n times so far away."""
_GOLDEN_ANGLE: Final = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, slots=True)
class Dots:
    """Spots in metres, with a colour each, #rrggbb, and a label each or none."""

    spots: tuple[scene.Point, ...]
    colours: tuple[str, ...]
    labels: tuple[str, ...] | None
    radius_m: float


@dataclass(frozen=True, slots=True)
class Lines:
    """Strips of spots in metres, each with a colour and half its width."""

    strips: tuple[tuple[scene.Point, ...], ...]
    colours: tuple[str, ...]
    radii_m: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Arrow:
    """From a spot in metres by a vector."""

    spot: scene.Point
    vector: scene.Point


@dataclass(frozen=True, slots=True)
class Graph:
    """Nodes by id, with spots in pixels of the screen, y downwards; edges by ids."""

    ids: tuple[str, ...]
    spots: tuple[scene.Point, ...]
    colours: tuple[str, ...]
    labels: tuple[str, ...]
    edges: tuple[tuple[str, str], ...]


Part = Dots | Lines | Arrow | Graph


def map_parts(view: MapView, *, everything: bool) -> dict[Path, Part]:
    """The whole map but for the robot, and without ``everything`` for Objects that are not
    confirmed."""
    places, objects = scene.places_of(view), scene.objects_of(view, everything=everything)
    ways = scene.ways_of(view, places)
    parts: dict[Path, Part] = {("graph",): _graph(view, places, objects, ways)}
    for floor, given in view.maps_in_force().items():
        ends = wall_segments(given.map)
        strips = tuple(((x0, y0), (x1, y1)) for x0, y0, x1, y1 in ends)
        if strips:
            parts[*_root(floor), "walls"] = _lines(strips, scene.WALL, 0.03)
    for floor in {k.floor: None for k in view.keyframes}:
        for name, part in _floor(view, floor, places, objects, ways):
            parts[*_root(floor), *name] = part
    return parts


def robot_parts(view: MapView) -> dict[Path, Part]:
    """The robot's position and heading at the latest keyframe with a pose."""
    latest = scene.robot_of(view)
    if latest is None or latest.pose is None:
        return {}
    yaw = latest.pose.yaw_rad
    vector = 0.6 * math.cos(yaw), 0.6 * math.sin(yaw)
    return {(*_root(latest.floor), "robot"): Arrow((latest.pose.x_m, latest.pose.y_m), vector)}


def _root(floor: str | None) -> Path:
    return ("map",) if floor is None else ("floors", floor)


def _floor(
    view: MapView,
    floor: str | None,
    all_places: Sequence[scene.ShownPlace],
    all_objects: Sequence[scene.ShownObject],
    all_ways: Sequence[scene.Way],
) -> Iterator[tuple[Path, Part]]:
    places = [p for p in all_places if p.floor == floor]
    regions = [(p.colour, outline) for p in places for outline in p.outlines]
    yield (
        ("regions",),
        Lines(
            tuple(outline for _, outline in regions),
            tuple(colour for colour, _ in regions),
            (0.04,) * len(regions),
        ),
    )
    yield (
        ("places",),
        Dots(
            tuple(p.centroid for p in places),
            tuple(p.colour for p in places),
            tuple(p.label for p in places),
            0.15,
        ),
    )
    objects = [o for o in all_objects if o.floor == floor]
    yield (
        ("objects",),
        Dots(
            tuple(o.record.spot for o in objects),
            tuple(_object_colour(o) for o in objects),
            tuple(o.label for o in objects),
            0.08,
        ),
    )
    ways = [way for way in all_ways if way.ends[0].floor == floor]
    yield (
        ("ways",),
        Lines(
            tuple((way.ends[0].centroid, way.ends[1].centroid) for way in ways),
            (scene.INK,) * len(ways),
            tuple(min(0.02 * way.transitions, 0.1) for way in ways),
        ),
    )
    posed = [k for k in view.keyframes if k.floor == floor and k.pose is not None]
    shown = scene.thinned(posed)
    yield (
        ("keyframes",),
        Dots(
            tuple(_spots(shown)),
            tuple(scene.FAINT if k.place is None else scene.place_colour(k.place) for k in shown),
            None,
            0.05,
        ),
    )
    runs: dict[str, list[KeyframeRecord]] = defaultdict(list)
    for k in posed:
        runs[k.run_id].append(k)
    for run_id, path in runs.items():
        if len(path) > 1:
            strips = (tuple(_spots(scene.thinned(path))),)
            yield ("path", run_id), _lines(strips, scene.FAINT, 0.015)


def _spots(keyframes: Iterable[KeyframeRecord]) -> list[scene.Point]:
    return [(k.pose.x_m, k.pose.y_m) for k in keyframes if k.pose is not None]


def _lines(strips: tuple[tuple[scene.Point, ...], ...], colour: str, radius_m: float) -> Lines:
    return Lines(strips, (colour,) * len(strips), (radius_m,) * len(strips))


def _object_colour(found: scene.ShownObject) -> str:
    place = found.record.place
    if found.missing:
        return _MISSING
    return scene.FAINT if place is None else scene.place_colour(place)


def _graph(
    view: MapView,
    places: Sequence[scene.ShownPlace],
    objects: Sequence[scene.ShownObject],
    ways: Sequence[scene.Way],
) -> Graph:
    spots = {_place_node(view, p.record.ordinal): _in_pixels(p.centroid) for p in places}
    edges = [
        (_place_node(view, a.record.ordinal), _place_node(view, b.record.ordinal))
        for a, b in (way.ends for way in ways)
    ]
    around: dict[PlaceOrdinal, int] = defaultdict(int)
    for found in objects:
        node, place = f"object/{found.record.object_id}", found.record.place
        if place is None:
            spots[node] = _in_pixels(found.record.spot)
        else:
            place_node = _place_node(view, place)
            edges.append((node, place_node))
            around[place] += 1
            spots[node] = _on_spiral(spots[place_node], around[place])
    colours = [*(p.colour for p in places), *(_object_colour(o) for o in objects)]
    labels = [*(p.label for p in places), *(o.label for o in objects)]
    return Graph(tuple(spots), tuple(spots.values()), tuple(colours), tuple(labels), tuple(edges))


def _place_node(view: MapView, place: PlaceOrdinal) -> str:
    return f"place/{view.all_places[place].place_id}"


def _in_pixels(spot: scene.Point) -> scene.Point:
    return spot[0] * _GRAPH_PX_PER_M, -spot[1] * _GRAPH_PX_PER_M


def _on_spiral(middle: scene.Point, n: int) -> scene.Point:
    away, angle = _RING_PX * math.sqrt(n), _GOLDEN_ANGLE * n
    return middle[0] + away * math.cos(angle), middle[1] + away * math.sin(angle)
