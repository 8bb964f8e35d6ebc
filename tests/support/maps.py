"""Occupancy maps for tests: drawn as text, and as the files of a map server."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from eventsrc.envelope.grey_images import encode_png
from eventsrc.envelope.occupancy_map import OCCUPIED, UNKNOWN, Cells, OccupancyMap

_VALUES = {"#": OCCUPIED, ".": 0, "?": UNKNOWN}
_SHADES = {"#": 0, ".": 254, "?": 205}


def cells(drawing: str) -> Cells:
    """Cells of a drawing as one looks at it: its last line is the row of the origin. ``#`` is
    occupied, ``.`` free, ``?`` unknown."""
    rows = [line.strip() for line in drawing.split()]
    return np.array([[_VALUES[c] for c in row] for row in reversed(rows)], np.uint8)


def drawn_map(
    drawing: str,
    resolution: float = 0.1,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    map_id: str | None = None,
) -> OccupancyMap:
    """The map of a drawing."""
    return OccupancyMap(map_id, resolution, origin, "drawing", cells(drawing))


def write_map_yaml(folder: Path, drawing: str, **fields: Any) -> Path:
    """``map.yaml`` and ``map.png`` of a drawing; ``fields`` replace those of the yaml."""
    rows = [[_SHADES[c] for c in line.strip()] for line in drawing.split()]
    (folder / "map.png").write_bytes(encode_png(np.array(rows, np.uint8)))
    document = {
        "image": "map.png",
        "mode": "trinary",
        "resolution": 0.1,
        "origin": [0.0, 0.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
        **fields,
    }
    path = folder / "map.yaml"
    lines = (f"{k}: {json.dumps(v)}\n" for k, v in document.items() if v is not None)
    path.write_text("".join(lines))
    return path


def grid_message(map_: OccupancyMap, **info: Any) -> dict[str, Any]:
    """A map as nav_msgs/OccupancyGrid; ``info`` replaces fields of its info."""
    x, y, yaw = map_.origin
    values = map_.cells.astype(int)
    return {
        "header": {"frame_id": "map", "stamp": {"sec": 1, "nanosec": 2}},
        "info": {
            "map_load_time": {"sec": 0, "nanosec": 0},
            "resolution": map_.resolution,
            "width": map_.width,
            "height": map_.height,
            "origin": {
                "position": {"x": x, "y": y, "z": 0.0},
                "orientation": {
                    "x": 0.0,
                    "y": 0.0,
                    "z": float(np.sin(yaw / 2)),
                    "w": float(np.cos(yaw / 2)),
                },
            },
            **info,
        },
        "data": np.where(values == UNKNOWN, -1, values).ravel().tolist(),
    }


def cdr_message(
    map_: OccupancyMap,
    *,
    big: bool = False,
    frame: str = "map",
    stamp: tuple[int, int] = (1, 2),
    loaded: tuple[int, int] = (0, 0),
) -> bytes:
    """A map as nav_msgs/OccupancyGrid in CDR, by the rules of the format: every number at a
    multiple of its size, from the end of the four bytes that it begins with."""
    body = b""

    def add(kind: str, value: float) -> None:
        nonlocal body
        body += bytes(-len(body) % struct.calcsize(kind))
        body += struct.pack((">" if big else "<") + kind, value)

    x, y, yaw = map_.origin
    name = frame.encode() + b"\0"
    for kind, value in [("i", stamp[0]), ("I", stamp[1]), ("I", len(name))]:
        add(kind, value)
    body += name
    for kind, value in [("i", loaded[0]), ("I", loaded[1]), ("f", map_.resolution)]:
        add(kind, value)
    add("I", map_.width)
    add("I", map_.height)
    for value in (x, y, 0.0, 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2))):
        add("d", value)
    add("I", map_.cells.size)
    body += map_.cells.tobytes()  # 255 is -1 as int8
    return (b"\0\0\0\0" if big else b"\0\1\0\0") + body
