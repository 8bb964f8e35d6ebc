"""The map as four tables of comma-separated values (RFC 4180); the first line has the names."""

import csv
import io
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from projections.map.view import MapView


def tables(view: MapView) -> dict[str, str]:
    """Text of each table, by the name of its file: places, objects, keyframes, adjacency.

    Rows are in the order in which the fold met what they are about. What is unknown is empty.
    """
    return {
        "places.csv": _places(view),
        "objects.csv": _objects(view),
        "keyframes.csv": _keyframes(view),
        "adjacency.csv": _table(
            ("a", "b", "shared_transitions"),
            ((view.place_id(a), view.place_id(b), count) for a, b, count in view.edges()),
        ),
    }


def _places(view: MapView) -> str:
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
    return _table((*names, "keyframe_count", "object_count"), rows)


def _objects(view: MapView) -> str:
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
            )
        )
    names = ("object_id", "class_name", "place_id", "mean_x", "mean_y", "est_x", "est_y")
    more = ("est_sigma_m", "obs_count", "first_seen", "last_seen", "missing")
    return _table((*names, *more), rows)


def _keyframes(view: MapView) -> str:
    names = ("offset", "run_id", "keyframe_id", "timestamp", "map_x", "map_y", "map_yaw")
    rows = []
    for k in view.keyframes:
        pose = (None,) * 3 if k.pose is None else (k.pose.x_m, k.pose.y_m, k.pose.yaw_rad)
        where = (*pose, view.place_id(k.place), k.floor)
        rows.append((k.offset, k.run_id, k.keyframe_id, k.timestamp, *where))
    return _table((*names, "place_id", "floor"), rows)


def _table(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text)  # its line ends are those of RFC 4180
    writer.writerow(names)
    writer.writerows(rows)
    return text.getvalue()
