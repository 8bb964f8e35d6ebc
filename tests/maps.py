"""Occupancy maps for tests: drawn as text, and as the files of a map server."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from eventsrc.grey_images import encode_png
from eventsrc.occupancy_map import OCCUPIED, UNKNOWN, Cells, OccupancyMap

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
