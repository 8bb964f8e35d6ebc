"""The digest of a map: SHA-256 over its canonical form.

Two maps have the same digest exactly when a reader could not tell them apart. The form is the
sections below in their order, one line for each thing by ordinal, each line a JSON array. Integers
are exact; a float is written as the shortest decimal that names it; an embedding enters by its
checksum. Settings, and how many events it took, are not part of it: the same map reached another
way has the same digest.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from typing import Any

from .view import MapView

VERSION = 1


def map_digest(view: MapView) -> str:
    """64 hex digits."""
    digest = hashlib.sha256(f"mapfold map {VERSION}\n".encode())
    for name, rows in _SECTIONS.items():
        digest.update(f"{name}\n".encode())
        for row in rows(view):
            digest.update(_line(row))
    return digest.hexdigest()


_encode = json.JSONEncoder(ensure_ascii=True, allow_nan=False, separators=(",", ":")).encode


def _line(row: Any) -> bytes:
    return _encode(row).encode("ascii") + b"\n"


def _runs(view: MapView) -> Iterator[Any]:
    return ((r.run_id, r.started_at) for r in view.runs)


def _keyframes(view: MapView) -> Iterator[Any]:
    for k in view.keyframes:
        pose = None if k.pose is None else (k.pose.x_um, k.pose.y_um, k.pose.yaw_rad)
        yield k.run, k.keyframe_id, k.timestamp, pose, k.place


def _observations(view: MapView) -> Iterator[Any]:
    for o in view.observations:
        seen = (o.keyframe, o.det_id, o.class_name, o.confidence, o.bbox)
        yield *seen, o.embedding_model, o.embedding_crc, o.foreign_space, o.object, o.similarity_q40


def _objects(view: MapView) -> Iterator[Any]:
    for o in view.objects:
        means = (o.obs_count, o.sum_x_um, o.sum_y_um, o.first_seen, o.last_seen)
        yield o.object_id, o.class_name, *means, o.place


def _places(view: MapView) -> Iterator[Any]:
    for p in view.places.values():
        yield p.ordinal, p.place_id, p.founder, p.keyframe_count, p.sum_x_um, p.sum_y_um


_SECTIONS: dict[str, Callable[[MapView], Iterator[Any]]] = {
    "runs": _runs,
    "keyframes": _keyframes,
    "observations": _observations,
    "objects": _objects,
    "places": _places,
    "adjacency": lambda view: iter(view.edges()),
}
