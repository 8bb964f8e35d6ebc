"""The map as GeoJSON (RFC 7946), for QGIS and other geographic programs.

GeoJSON's coordinates are longitude and latitude. A map is in metres of its own frame; `Origin` says
where on Earth that frame is. Without one the coordinates are metres, and the collection says so in
its member ``coordinates``.
"""

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final

from projections.adapters.scene import Point, places_of
from projections.map.records import body_fields
from projections.map.view import MapView

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
    features = [*_places(view, place), *_objects(view, place), *_edges(view, place)]
    features += _runs(view, place)
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


def _places(view: MapView, at: _Placing) -> Iterable[dict[str, Any]]:
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


def _objects(view: MapView, at: _Placing) -> Iterable[dict[str, Any]]:
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


def _edges(view: MapView, at: _Placing) -> Iterable[dict[str, Any]]:
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


def _runs(view: MapView, at: _Placing) -> Iterable[dict[str, Any]]:
    paths: dict[str, list[Point]] = {run.run_id: [] for run in view.runs}
    for k in view.keyframes:
        if k.pose is not None:
            paths[k.run_id].append(at(k.pose.x_m, k.pose.y_m))
    for run_id, path in paths.items():
        if len(path) > 1:
            yield _feature("run", "LineString", path, run_id=run_id)
