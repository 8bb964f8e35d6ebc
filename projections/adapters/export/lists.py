"""The map as lists: four tables of comma-separated values, and Nav2 waypoints.

Tables are those of RFC 4180; the first line has the names. A spreadsheet takes a cell that begins
with ``=``, ``+``, ``-``, ``@``, a tab or a line break for a formula, and names come from the
network: such texts, and those that begin with an apostrophe, get an apostrophe before them, unless
the tables are ``raw``. Numbers stay as they are.

Waypoints are in the file that the Nav2 panel of RViz saves and loads. Each waypoint has ``pose``
[x, y, z] in metres and ``orientation`` [w, x, y, z], as ``nav2_rviz_plugins`` reads them; it takes
them in the order of the file and ignores other keys.
"""

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, Final

import yaml

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
