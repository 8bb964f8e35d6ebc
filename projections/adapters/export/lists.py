"""The map as lists: four tables of comma-separated values, Nav2 waypoints, and the features of
GeoJSON (RFC 7946).

Tables are those of RFC 4180; the first line has the names. A spreadsheet takes a cell that begins
with ``=``, ``+``, ``-``, ``@``, a tab or a line break for a formula, and names come from the
network: such texts, and those that begin with an apostrophe, get an apostrophe before them, unless
the tables are ``raw``. Numbers stay as they are.

Waypoints are in the file that the Nav2 panel of RViz saves and loads. Each waypoint has ``pose``
[x, y, z] in metres and ``orientation`` [w, x, y, z], as ``nav2_rviz_plugins`` reads them; it takes
them in the order of the file and ignores other keys.

GeoJSON's coordinates are longitude and latitude. A map is in metres of its own frame; `Origin` says
where on Earth that frame is. Without one the coordinates are metres, and the collection says so in
its member ``coordinates``.
"""

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import yaml

from projections.adapters.scene import Point, places_of
from projections.map.records import ObjectRecord, PlaceRecord, body_fields
from projections.map.view import MapView

_Table = tuple[Sequence[str], Iterable[Sequence[Any]]]
_BEGINNINGS: Final = ("=", "+", "-", "@", "\t", "\r", "\n", "'")


def tables(view: MapView, *, raw: bool = False) -> dict[str, str]:
    """Text of each table, by the name of its file: places, objects, keyframes, adjacency.

    Rows are in the order in which the fold met what they are about. What is unknown is empty.
    """
    edges = ((view.place_id(a), view.place_id(b), count) for a, b, count in view.edges())
    found = {
        "places.csv": _places(view),
        "objects.csv": _objects(view),
        "keyframes.csv": _keyframes(view),
        "adjacency.csv": (("a", "b", "shared_transitions"), edges),
    }
    return {name: _text(*table, raw=raw) for name, table in found.items()}


def _places(view: MapView) -> _Table:
    objects = Counter(found.place for found in view.objects.values())
    rows = []
    for place in view.places.values():
        kind = view.type_of(place.ordinal)
        sure = kind if kind is not None and kind.type is not None else None
        rows.append(
            (
                place.place_id,
                place.name,
                None if sure is None else sure.type,
                None if sure is None else sure.probability,
                view.floor_of(place.ordinal),
                place.centroid_x,
                place.centroid_y,
                place.keyframe_count,
                objects[place.ordinal],
            )
        )
    names = ("place_id", "name", "type", "type_probability", "floor", "centroid_x", "centroid_y")
    return (*names, "keyframe_count", "object_count"), rows


def _objects(view: MapView) -> _Table:
    rows = []
    for found in view.objects.values():
        at = found.estimate
        rows.append(
            (
                found.object_id,
                found.class_name,
                view.place_id(found.place),
                found.mean_x,
                found.mean_y,
                None if at is None else at.est_x,
                None if at is None else at.est_y,
                None if at is None else at.est_sigma_m,
                found.obs_count,
                found.first_seen,
                found.last_seen,
                "true" if found.missing_in is not None else "false",
                "true" if found.confirmed else "false",
                *(_body(view, found) if view.has_bodies else ()),
            )
        )
    names = ("object_id", "class_name", "place_id", "mean_x", "mean_y", "est_x", "est_y")
    more = ("est_sigma_m", "obs_count", "first_seen", "last_seen", "missing", "confirmed")
    body = ("z", "length", "width", "height") if view.has_bodies else ()
    return (*names, *more, *body), rows


def _body(view: MapView, found: ObjectRecord) -> Sequence[float | None]:
    fields = body_fields(view.body_of(found))
    return fields.get("z"), *fields.get("size", (None,) * 3)


def _keyframes(view: MapView) -> _Table:
    names = ("offset", "run_id", "keyframe_id", "timestamp", "map_x", "map_y", "map_yaw")
    rows = []
    for k in view.keyframes:
        pose = (None,) * 3 if k.pose is None else (k.pose.x_m, k.pose.y_m, k.pose.yaw_rad)
        where = (*pose, view.place_id(k.place), k.floor)
        rows.append((k.offset, k.run_id, k.keyframe_id, k.timestamp, *where))
    return (*names, "place_id", "floor"), rows


def _text(names: Sequence[str], rows: Iterable[Sequence[Any]], *, raw: bool) -> str:
    text = io.StringIO()
    writer = csv.writer(text)  # its line ends are those of RFC 4180
    writer.writerow(names)
    writer.writerows(rows if raw else ([_cell(value) for value in row] for row in rows))
    return text.getvalue()


def _cell(value: Any) -> Any:
    begins_formula = isinstance(value, str) and value.startswith(_BEGINNINGS)
    return f"'{value}" if begins_formula else value


NEAR_M: Final = 0.5
"""Most metres from a centroid to the nearest pose of its Place; farther ones may lie in a wall or
in furniture."""


def nav2_waypoints(view: MapView) -> str:
    """A waypoint for each Place, in the order in which the Places were founded.

    It is the centroid, facing as the robot did at the keyframe of the Place that is nearest to it.
    Where the robot never was within 0.5 m of the centroid, it is that keyframe's pose.
    """
    waypoints = {
        place.place_id: _waypoint(view, place)
        | ({} if place.name is None else {"name": place.name})
        for place in view.places.values()
    }
    text: str = yaml.safe_dump({"waypoints": waypoints}, sort_keys=False)
    return text


def _waypoint(view: MapView, place: PlaceRecord) -> dict[str, Any]:
    x, y = place.centroid_x, place.centroid_y
    poses = [pose for k in place.members if (pose := view.keyframes[k].pose) is not None]
    nearest = min(poses, key=lambda pose: math.hypot(pose.x_m - x, pose.y_m - y))
    if math.hypot(nearest.x_m - x, nearest.y_m - y) > NEAR_M:
        x, y = nearest.x_m, nearest.y_m
    half = nearest.yaw_rad / 2
    return {
        "pose": [x, y, 0.0],
        "orientation": [round(math.cos(half), 9), 0.0, 0.0, round(math.sin(half), 9)],
    }


_WGS84_A_M: Final = 6_378_137.0
_WGS84_E2: Final = 6.694_379_990_141_316e-3
_DECIMALS: Final = 9
"""Decimals of a degree: 0.1 mm."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Where (0, 0) of the map frame is, degrees north and east (WGS 84), and the direction of its x
    axis, degrees counter-clockwise from east."""

    latitude: float
    longitude: float
    yaw: float = 0.0

    def geographic(self, x: float, y: float) -> Point:
        """Longitude and latitude of a point of the map frame, metres. The plane that touches the
        ellipsoid at the origin: 1 km away from it this is off by a few centimetres."""
        turn, latitude = math.radians(self.yaw), math.radians(self.latitude)
        east = x * math.cos(turn) - y * math.sin(turn)
        north = x * math.sin(turn) + y * math.cos(turn)
        squeeze = 1 - _WGS84_E2 * math.sin(latitude) ** 2
        meridian = _WGS84_A_M * (1 - _WGS84_E2) / squeeze**1.5
        prime_vertical = _WGS84_A_M / math.sqrt(squeeze)
        return (
            round(
                self.longitude + math.degrees(east / (prime_vertical * math.cos(latitude))),
                _DECIMALS,
            ),
            round(self.latitude + math.degrees(north / meridian), _DECIMALS),
        )


def geojson(view: MapView, origin: Origin | None = None) -> str:
    """A FeatureCollection: each Place as its region, where walls are known, or the convex
    hull of its poses; each Object as a point, each
    pair of adjacent Places as the line between their centroids, each run as its path.

    The property ``kind`` of a feature is place, object, adjacency or run.
    """
    place = (lambda x, y: (x, y)) if origin is None else origin.geographic
    frame = {"coordinates": "metres of the map frame"} if origin is None else {}
    features = [
        *_place_features(view, place),
        *_object_features(view, place),
        *_edge_features(view, place),
    ]
    features += _run_features(view, place)
    document = {"type": "FeatureCollection", **frame, "features": features}
    return json.dumps(document, ensure_ascii=True, allow_nan=False) + "\n"


_Placing = Callable[[float, float], Point]


def _feature(kind: str, shape: str, coordinates: Any, **values: Any) -> dict[str, Any]:
    known = {name: value for name, value in values.items() if value is not None}
    return {
        "type": "Feature",
        "geometry": {"type": shape, "coordinates": coordinates},
        "properties": {"kind": kind, **known},
    }


def _place_features(view: MapView, at: _Placing) -> Iterable[dict[str, Any]]:
    for shown in places_of(view):
        place, kind = shown.record, view.type_of(shown.record.ordinal)
        values = {
            "place_id": place.place_id,
            "name": place.name,
            "type": None if kind is None else kind.type,
            "floor": shown.floor,
            "keyframe_count": place.keyframe_count,
        }
        if (region := shown.region) is not None:
            parts = [[[at(*p) for p in ring] for ring in rings] for rings in region.polygons]
            if len(parts) > 1:
                yield _feature("place", "MultiPolygon", parts, area_m2=region.area_m2, **values)
            else:
                yield _feature("place", "Polygon", parts[0], area_m2=region.area_m2, **values)
        elif shown.outlines:
            closed = [[at(*p) for p in ring] for ring in shown.outlines]
            yield _feature("place", "Polygon", closed, **values)
        else:
            yield _feature("place", "Point", at(*shown.centroid), **values)


def _object_features(view: MapView, at: _Placing) -> Iterable[dict[str, Any]]:
    for found in view.objects.values():
        yield _feature(
            "object",
            "Point",
            at(*found.spot),
            object_id=found.object_id,
            class_name=found.class_name,
            place_id=view.place_id(found.place),
            obs_count=found.obs_count,
            sigma_m=None if found.estimate is None else found.estimate.est_sigma_m,
            missing=True if found.missing_in is not None else None,
            confirmed=found.confirmed,
            **body_fields(view.body_of(found)),
        )


def _edge_features(view: MapView, at: _Placing) -> Iterable[dict[str, Any]]:
    for a, b, transitions in view.edges():
        ends = [view.places[each] for each in (a, b)]
        yield _feature(
            "adjacency",
            "LineString",
            [at(end.centroid_x, end.centroid_y) for end in ends],
            a=ends[0].place_id,
            b=ends[1].place_id,
            shared_transitions=transitions,
        )


def _run_features(view: MapView, at: _Placing) -> Iterable[dict[str, Any]]:
    paths: dict[str, list[Point]] = {run.run_id: [] for run in view.runs}
    for k in view.keyframes:
        if k.pose is not None:
            paths[k.run_id].append(at(k.pose.x_m, k.pose.y_m))
    for run_id, path in paths.items():
        if len(path) > 1:
            yield _feature("run", "LineString", path, run_id=run_id)
