"""A room of known things, driven through twice: envelopes for tests of fusion by evidence.

One thing of each class stands in a room of 6 × 6 m. A robot stands at random spots and heads for
one of them; it detects everything in view, by default in a picture of 800 × 600 pixels, 90° wide.
Bearings and poses have known errors. Everything is seen from all sides.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.support.envelopes import detection, envelope
from tests.support.logs import write_log

CAMERA = {"hfov_deg": 90.0, "width_px": 800.0, "height_px": 600.0}
DIM = 32
BEARING_RAD = 0.02
POSE_M = 0.03
SIZES = {"bed": 0.7, "chair": 0.9, "clock": 0.3, "lamp": 1.4, "plant": 0.6, "table": 0.8}


def things_of(seed: int) -> dict[str, NDArray[np.float64]]:
    """Where the thing of each class stands."""
    rng = np.random.default_rng(seed)
    return {name: rng.uniform(-3.0, 3.0, 2) for name in SIZES}


def drive(
    seed: int,
    run_id: str,
    count: int,
    *,
    camera: bool = True,
    by: Mapping[str, float] = CAMERA,
) -> list[dict[str, Any]]:
    """The envelopes of one run; all runs of one seed are through the same room. The pictures are
    taken ``by`` a camera, which the envelopes state if ``camera``."""
    width, height, mounted = by["width_px"], by["height_px"], by.get("yaw_rad", 0.0)
    focal = width / 2 / math.tan(math.radians(by["hfov_deg"] / 2))
    things = things_of(seed)
    rng = np.random.default_rng([seed, sum(run_id.encode())])
    shared = np.random.default_rng(seed + 1)
    space = shared.normal(size=DIM) * 0.7
    looks = {name: space + shared.normal(size=DIM) for name in SIZES}
    documents = []
    for keyframe in range(count):
        while True:
            spot = rng.uniform(-3.0, 3.0, 2)
            if min(math.dist(spot, at) for at in things.values()) > 0.5:
                break
        goal = things[list(SIZES)[int(rng.integers(len(SIZES)))]]
        yaw = math.atan2(goal[1] - spot[1], goal[0] - spot[0]) + float(rng.normal()) * 0.3
        yaw -= mounted
        seen = []
        for name, at in things.items():
            towards = math.atan2(at[1] - spot[1], at[0] - spot[0]) - yaw - mounted
            off = math.remainder(towards, 2 * math.pi)
            off += BEARING_RAD * float(rng.normal())
            if abs(off) > 0.75 * by["hfov_deg"] / 90.0:
                continue
            tall = SIZES[name] * focal / (math.dist(spot, at) * math.cos(off))
            middle = width / 2 - focal * math.tan(off)
            top, bottom = max((height - tall) / 2, 0.0), min((height + tall) / 2, height)
            box = [middle - 8.0, top, middle + 8.0, bottom]
            vector = looks[name] + 0.35 * rng.normal(size=DIM)
            seen.append(detection(name, vector, bbox=[round(v, 2) for v in box]))
        fields: dict[str, Any] = {"run_id": run_id, "map_yaw": yaw, "detections": seen}
        if camera:
            fields["camera"] = by
        stands = spot + rng.normal(0.0, POSE_M, 2)
        documents.append(envelope(keyframe, float(stands[0]), float(stands[1]), **fields))
    return documents


def write_room(path: Path, *, seed: int = 4, count: int = 80, camera: bool = True) -> Path:
    """A log of two runs through a room."""
    first = drive(seed, "run-a", count, camera=camera)
    return write_log(path, [*first, *drive(seed, "run-b", count, camera=camera)])
