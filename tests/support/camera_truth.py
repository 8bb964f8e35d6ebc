"""Which thing each detection on a drawn picture shows, from what the picture truly shows."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

LEAST_OVERLAP = 0.5


def truth_of(envelopes: Iterable[dict[str, Any]], truth: Path) -> list[dict[str, Any]]:
    """Truth in the form of `evaluate`, a document for each envelope.

    A detection shows the thing of its class whose box overlaps its own most, by half at least.
    """
    pictures = {p["stamp"]: p for p in map(json.loads, truth.read_text().splitlines())}
    return [_of_one(envelope, pictures[envelope["timestamp"]]) for envelope in envelopes]


def _of_one(envelope: dict[str, Any], picture: dict[str, Any]) -> dict[str, Any]:
    return {
        "run_id": envelope["run_id"],
        "keyframe_id": envelope["keyframe_id"],
        "room": picture["room"],
        "instances": [_instance(d, picture["things"]) for d in envelope["detections"]],
    }


def _instance(detection: dict[str, Any], things: list[dict[str, Any]]) -> str | None:
    near = [
        (_overlap(detection["bbox"], thing["box"]), thing["instance"])
        for thing in things
        if thing["class"] == detection["class"]
    ]
    best = max(near, default=(0.0, None))
    return best[1] if best[0] >= LEAST_OVERLAP else None


def _overlap(one: list[float], other: list[float]) -> float:
    sides = [min(one[i + 2], other[i + 2]) - max(one[i], other[i]) for i in (0, 1)]
    shared = max(0.0, sides[0]) * max(0.0, sides[1])
    areas = [(b[2] - b[0]) * (b[3] - b[1]) for b in (one, other)]
    return shared / (sum(areas) - shared)
