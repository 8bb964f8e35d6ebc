"""A map as one JSON document, ``mapfold state --json`` (DESIGN section 8)."""

from typing import Any

from .view import MapView


def state_document(view: MapView, digest: str) -> dict[str, Any]:
    """The document. Every list is in the order in which the fold met or founded its things."""
    return {
        "offset": view.next_offset,
        "settings": view.settings.model_dump(),
        "digest": digest,
        "counts": view.counts(),
        "keyframes": _keyframes(view),
        "places": _places(view),
        "objects": _objects(view),
        "adjacency": [
            {"a": view.place_id(a), "b": view.place_id(b), "shared_transitions": transitions}
            for a, b, transitions in view.edges()
        ],
    }


def _keyframes(view: MapView) -> list[dict[str, Any]]:
    return [
        {
            "run_id": k.run_id,
            "keyframe_id": k.keyframe_id,
            "map_x": None if k.pose is None else k.pose.x_m,
            "map_y": None if k.pose is None else k.pose.y_m,
            "map_yaw": None if k.pose is None else k.pose.yaw_rad,
            "place_id": view.place_id(k.place),
        }
        for k in view.keyframes
    ]


def _places(view: MapView) -> list[dict[str, Any]]:
    return [
        {
            "place_id": p.place_id,
            "centroid_x": p.centroid_x,
            "centroid_y": p.centroid_y,
            "keyframe_count": p.keyframe_count,
        }
        for p in view.places.values()
    ]


def _objects(view: MapView) -> list[dict[str, Any]]:
    return [
        {
            "object_id": o.object_id,
            "class_name": o.class_name,
            "mean_x": o.mean_x,
            "mean_y": o.mean_y,
            "obs_count": o.obs_count,
            "place_id": view.place_id(o.place),
            "first_seen": o.first_seen,
            "last_seen": o.last_seen,
            "det_ids": [view.observations[i].det_id for i in o.observations],
        }
        for o in view.objects
    ]
