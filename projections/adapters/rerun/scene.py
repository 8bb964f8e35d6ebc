"""A map as what Rerun shows: points, lines, an arrow and a graph, each at the path of its entity.

| path | what |
|---|---|
| ``map/walls`` | the outline of an occupancy map's walls |
| ``map/regions``, ``map/places`` | the hull of each Place's poses, and its centroid with its name |
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

from projections.adapters import palette
from projections.adapters.export import Point, hull
from projections.fold.deltas import PlaceOrdinal
from projections.map.records import KeyframeRecord, PlaceRecord
from projections.map.view import MapView
from projections.map.wall_segments import wall_segments

Path = tuple[str, ...]
"""The path of an entity: its parts, not escaped."""
_MOST_POSES: Final = 2_000
"""Most poses of a run's path, and of a floor's keyframes; more are thinned out."""
_MISSING: Final = "#d91a26"
_GRAPH_PX_PER_M: Final = 110.0
_RING_PX: Final = 62.0
"""In the graph Objects are in a spiral around their Place, the n-th √n times so far away."""
_GOLDEN_ANGLE: Final = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, slots=True)
class Points:
    """Spots in metres, with a colour each, #rrggbb, and a label each or none."""

    spots: tuple[Point, ...]
    colours: tuple[str, ...]
    labels: tuple[str, ...] | None
    radius_m: float


@dataclass(frozen=True, slots=True)
class Lines:
    """Strips of spots in metres, each with a colour and half its width."""

    strips: tuple[tuple[Point, ...], ...]
    colours: tuple[str, ...]
    radii_m: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Arrow:
    """From a spot in metres by a vector."""

    spot: Point
    vector: Point


@dataclass(frozen=True, slots=True)
class Graph:
    """Nodes by id, with spots in pixels of the screen, y downwards; edges by ids."""

    ids: tuple[str, ...]
    spots: tuple[Point, ...]
    colours: tuple[str, ...]
    labels: tuple[str, ...]
    edges: tuple[tuple[str, str], ...]


Part = Points | Lines | Arrow | Graph


def map_parts(view: MapView) -> dict[Path, Part]:
    """The whole map but for the robot."""
    parts: dict[Path, Part] = {("graph",): _graph(view)}
    for floor, given in view.maps_in_force().items():
        ends = wall_segments(given.map)
        strips = tuple(((x0, y0), (x1, y1)) for x0, y0, x1, y1 in ends)
        if strips:
            parts[*_root(floor), "walls"] = _lines(strips, palette.WALL, 0.03)
    for floor in {k.floor: None for k in view.keyframes}:
        for name, part in _floor(view, floor):
            parts[*_root(floor), *name] = part
    return parts


def robot_parts(view: MapView) -> dict[Path, Part]:
    """The robot's position and heading at the latest keyframe with a pose."""
    latest = next((k for k in reversed(view.keyframes) if k.pose is not None), None)
    if latest is None or latest.pose is None:
        return {}
    yaw = latest.pose.yaw_rad
    vector = 0.6 * math.cos(yaw), 0.6 * math.sin(yaw)
    return {(*_root(latest.floor), "robot"): Arrow((latest.pose.x_m, latest.pose.y_m), vector)}


def place_label(view: MapView, place: PlaceRecord) -> str:
    """The name of a Place or its likely type, and its id."""
    kind = view.type_of(place.ordinal)
    label = place.name or (kind.type if kind is not None else None)
    return place.place_id if label is None else f"{label} ({place.place_id})"


def _root(floor: str | None) -> Path:
    return ("map",) if floor is None else ("floors", floor)


def _floor(view: MapView, floor: str | None) -> Iterator[tuple[Path, Part]]:
    places = [p for p in view.places.values() if view.floor_of(p.ordinal) == floor]
    rings = [(p, hull(view.keyframes[member].pose for member in p.members)) for p in places]
    regions = [(p, (*ring, ring[0])) for p, ring in rings if len(ring) > 2]
    yield (
        ("regions",),
        Lines(
            tuple(ring for _, ring in regions),
            tuple(palette.place_colour(p.ordinal) for p, _ in regions),
            (0.04,) * len(regions),
        ),
    )
    yield (
        ("places",),
        Points(
            tuple((p.centroid_x, p.centroid_y) for p in places),
            tuple(palette.place_colour(p.ordinal) for p in places),
            tuple(place_label(view, p) for p in places),
            0.15,
        ),
    )
    objects = [o for o in view.objects.values() if _floor_of_object(view, o.observations) == floor]
    yield (
        ("objects",),
        Points(
            tuple(o.spot for o in objects),
            tuple(_object_colour(o.place, missing=o.missing_in is not None) for o in objects),
            tuple(_class(o.class_name, missing=o.missing_in is not None) for o in objects),
            0.08,
        ),
    )
    edges = [edge for edge in view.edges() if view.floor_of(edge[0]) == floor]
    yield (
        ("ways",),
        Lines(
            tuple((_centroid(view, a), _centroid(view, b)) for a, b, _ in edges),
            (palette.INK,) * len(edges),
            tuple(min(0.02 * transitions, 0.1) for _, _, transitions in edges),
        ),
    )
    posed = [k for k in view.keyframes if k.floor == floor and k.pose is not None]
    shown = _thinned(posed)
    yield (
        ("keyframes",),
        Points(
            tuple(_spots(shown)),
            tuple(
                palette.FAINT if k.place is None else palette.place_colour(k.place) for k in shown
            ),
            None,
            0.05,
        ),
    )
    runs: dict[str, list[KeyframeRecord]] = defaultdict(list)
    for k in posed:
        runs[k.run_id].append(k)
    for run_id, path in runs.items():
        if len(path) > 1:
            strips = (tuple(_spots(_thinned(path))),)
            yield ("path", run_id), _lines(strips, palette.FAINT, 0.015)


def _floor_of_object(view: MapView, observations: Sequence[int]) -> str | None:
    return view.keyframes[view.observations[observations[0]].keyframe].floor


def _centroid(view: MapView, place: PlaceOrdinal) -> Point:
    found = view.places[place]
    return found.centroid_x, found.centroid_y


def _spots(keyframes: Iterable[KeyframeRecord]) -> list[Point]:
    return [(k.pose.x_m, k.pose.y_m) for k in keyframes if k.pose is not None]


def _thinned(keyframes: Sequence[KeyframeRecord]) -> Sequence[KeyframeRecord]:
    """At most `_MOST_POSES` and one of them, the last one included."""
    step = -(-len(keyframes) // _MOST_POSES)
    return [*keyframes[:-1:step], keyframes[-1]] if keyframes else []


def _lines(strips: tuple[tuple[Point, ...], ...], colour: str, radius_m: float) -> Lines:
    return Lines(strips, (colour,) * len(strips), (radius_m,) * len(strips))


def _object_colour(place: PlaceOrdinal | None, *, missing: bool) -> str:
    return _MISSING if missing else _colour(place)


def _colour(place: PlaceOrdinal | None) -> str:
    return palette.FAINT if place is None else palette.place_colour(place)


def _class(class_name: str, *, missing: bool) -> str:
    return f"{class_name} (missing)" if missing else class_name


def _graph(view: MapView) -> Graph:
    spots: dict[str, Point] = {}
    colours, labels = [], []
    for place in view.places.values():
        spots[_place_node(view, place.ordinal)] = _in_pixels((place.centroid_x, place.centroid_y))
        colours.append(palette.place_colour(place.ordinal))
        labels.append(place_label(view, place))
    edges = [(_place_node(view, a), _place_node(view, b)) for a, b, _ in view.edges()]
    around: dict[PlaceOrdinal, int] = defaultdict(int)
    for found in view.objects.values():
        node, missing = f"object/{found.object_id}", found.missing_in is not None
        if found.place is None:
            spots[node] = _in_pixels(found.spot)
        else:
            place_node = _place_node(view, found.place)
            edges.append((node, place_node))
            around[found.place] += 1
            spots[node] = _on_spiral(spots[place_node], around[found.place])
        colours.append(_object_colour(found.place, missing=missing))
        labels.append(_class(found.class_name, missing=missing))
    return Graph(tuple(spots), tuple(spots.values()), tuple(colours), tuple(labels), tuple(edges))


def _place_node(view: MapView, place: PlaceOrdinal) -> str:
    return f"place/{view.all_places[place].place_id}"


def _in_pixels(spot: Point) -> Point:
    return spot[0] * _GRAPH_PX_PER_M, -spot[1] * _GRAPH_PX_PER_M


def _on_spiral(middle: Point, n: int) -> Point:
    away, angle = _RING_PX * math.sqrt(n), _GOLDEN_ANGLE * n
    return middle[0] + away * math.cos(angle), middle[1] + away * math.sin(angle)
