"""The digest of a map: SHA-256 over its canonical form.

The canonical form is the sections of `_SECTIONS` in their order, one line for each thing by
ordinal, each line a JSON array. Integers are exact, a float is written as the shortest decimal that
names it, an embedding enters by its checksum. Settings and the number of events are not part of it:
the same map reached another way has the same digest. Under corrections there are two more sections:
the places' names, and the corrections' fingerprint. Under fusion by evidence there is one more
before them: of each Object its estimate, whether it is missing, and its relocations. Where any
keyframe's floor has a name there is one before that: of each of these keyframes the floor. Where a
height or a size is measured there is one of these observations. With an occupancy map there is one
more, of its cells and where they lie, before those of corrections; maps that name a floor follow
it, by name.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from itertools import islice
from json.encoder import encode_basestring_ascii as _text
from typing import Any

from .view import MapView

VERSION = 1
_LINES_AT_ONCE = 500


def map_digest(view: MapView) -> str:
    """The digest of a view: 64 hex digits."""
    if (known := view.known_digest()) is not None:
        return known
    found = _computed(view)
    view.keep_digest(found)
    return found


def _computed(view: MapView) -> str:
    digest = hashlib.sha256(f"mapfold map {VERSION}\n".encode())
    for name, lines in _SECTIONS.items():
        digest.update(f"{name}\n".encode())
        remaining = lines(view)
        while chunk := "".join(islice(remaining, _LINES_AT_ONCE)):
            digest.update(chunk.encode("ascii"))
    if view.floors or view.frames:
        floors = (_line((k.ordinal, k.floor)) for k in view.keyframes if k.floor is not None)
        digest.update(f"floors\n{''.join(floors)}".encode())
        frames = [_line((k.ordinal, k.frame)) for k in view.keyframes if k.frame is not None]
        digest.update(f"frames\n{''.join(frames)}".encode() if frames else b"")
    if view.settings.fusion == "evidence":
        digest.update(b"evidence\n")
        for line in _evidence(view):
            digest.update(line.encode())
    if view.has_bodies:
        digest.update(f"bodies\n{''.join(_bodies(view))}".encode())
    if (given := view.maps.get(None)) is not None:
        digest.update(f"map\n{_line(given.map.digest())}".encode())
    if named := sorted((floor, g.map) for floor, g in view.maps.items() if floor is not None):
        lines_of_maps = (_line((floor, each.digest())) for floor, each in named)
        digest.update(f"maps of floors\n{''.join(lines_of_maps)}".encode())
    if own := view.corrections.fingerprint():
        names = [_line((p.ordinal, p.name)) for p in view.places.values() if p.name is not None]
        digest.update(f"names\n{''.join(names)}corrections\n{_line(own)}".encode())
    return digest.hexdigest()


def _line(row: Any) -> str:
    return json.dumps(row, allow_nan=False, separators=(",", ":")) + "\n"


def _runs(view: MapView) -> Iterator[str]:
    return (_line((r.run_id, r.started_at)) for r in view.runs)


# Long sections are formatted here, twice as fast as with an encoder. `repr` of an int or a finite
# float is its JSON.


def _keyframes(view: MapView) -> Iterator[str]:
    for k in view.keyframes:
        at = k.pose
        pose = "null" if at is None else f"[{at.x_um},{at.y_um},{at.yaw_rad!r}]"
        yield f"[{k.run},{k.keyframe_id},{k.timestamp!r},{pose},{_number(k.place)}]\n"


def _observations(view: MapView) -> Iterator[str]:
    for o in view.observations:
        x0, y0, x1, y1 = o.bbox
        model = "null" if o.embedding_model is None else _text(o.embedding_model)
        yield (
            f"[{o.keyframe},{_text(o.det_id)},{_text(o.class_name)},{o.confidence!r},"
            f"[{x0!r},{y0!r},{x1!r},{y1!r}],{model},{_number(o.embedding_crc)},"
            f"{'true' if o.foreign_space else 'false'},{_number(o.object)},"
            f"{_number(o.similarity_q40)}]\n"
        )


def _objects(view: MapView) -> Iterator[str]:
    for o in view.objects.values():
        yield (
            f"[{_text(o.object_id)},{_text(o.class_name)},{o.obs_count},{o.sum_x_um},{o.sum_y_um},"
            f"{o.first_seen!r},{o.last_seen!r},{_number(o.place)}]\n"
        )


def _evidence(view: MapView) -> Iterator[str]:
    for o in view.objects.values():
        at = o.estimate
        estimate = at and (at.x_um, at.y_um, at.var_xx_um2, at.var_xy_um2, at.var_yy_um2, at.spots)
        relocations = [
            (r.offset, r.observation, r.from_x_um, r.from_y_um, r.to_x_um, r.to_y_um)
            for r in o.relocations
        ]
        yield _line((o.ordinal, estimate, o.misses, o.missing_in, relocations))


def _bodies(view: MapView) -> Iterator[str]:
    for o in view.observations:
        if (e := o.body) is not None:
            yield _line((o.ordinal, e.z_um, e.length_um, e.width_um, e.height_um))


def _number(value: int | None) -> str:
    return "null" if value is None else str(value)


def _places(view: MapView) -> Iterator[str]:
    for p in view.places.values():
        yield _line((p.ordinal, p.place_id, p.founder, p.keyframe_count, p.sum_x_um, p.sum_y_um))


_SECTIONS: dict[str, Callable[[MapView], Iterator[str]]] = {
    "runs": _runs,
    "keyframes": _keyframes,
    "observations": _observations,
    "objects": _objects,
    "places": _places,
    "adjacency": lambda view: map(_line, view.edges()),
}
