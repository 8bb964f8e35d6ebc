"""From sightings to detections, with a detector's faults.

It misses some, gets boxes wrong by a few pixels, is less sure of far things, names 4 % wrongly (a
class of about the same size), and sees something that is not there in 2 % of the keyframes.
"""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .camera import HEIGHT_PX, RANGE_M, WIDTH_PX, Box, Sighting
from .catalogue import MODELS
from .chance import happens, normal, uniform
from .embedding import DIM, MODEL_NAME, embed

MISS_RATE = 0.08
WRONG_LABEL_RATE = 0.04
FALSE_POSITIVE_RATE = 0.02
_BOX_NOISE_PX = 4.0

CLASSES = tuple(sorted({model.class_name for model in MODELS.values()}))


@dataclass(frozen=True, slots=True)
class Detection:
    """One detection as the envelope has it, but for its id, and the true instance behind it."""

    fields: dict[str, Any]
    instance: str | None


def detect(seen: Iterator[Sighting], session: str, rng: np.random.Generator) -> Iterator[Detection]:
    """What the detector says about one keyframe's sightings."""
    for sighting in seen:
        if not happens(rng, MISS_RATE):
            yield _detection(sighting, session, rng)
    if happens(rng, FALSE_POSITIVE_RATE):
        yield _phantom(session, rng)


def _detection(sighting: Sighting, session: str, rng: np.random.Generator) -> Detection:
    model, instance = sighting.thing.model, sighting.thing.instance
    vector = embed(model.class_name, model.name, instance, sighting.side_rad, session, rng)
    label = _mistaken(model.class_name, rng) if happens(rng, WRONG_LABEL_RATE) else model.class_name
    sure = 0.93 - 0.22 * sighting.distance_m / RANGE_M[1] + 0.06 * normal(rng)
    if label != model.class_name:
        sure -= 0.25
    return Detection(_fields(label, sure, _shaken(sighting.box, rng), vector), instance)


def _phantom(session: str, rng: np.random.Generator) -> Detection:
    label = CLASSES[int(rng.integers(0, len(CLASSES)))]
    nothing = f"phantom-{int(rng.integers(0, 2**62))}"
    x, y = uniform(rng, 0, WIDTH_PX - 120), uniform(rng, 0, HEIGHT_PX - 120)
    box = (x, y, x + uniform(rng, 30, 120), y + uniform(rng, 30, 120))
    vector = embed(label, nothing, nothing, 0.0, session, rng)
    return Detection(_fields(label, uniform(rng, 0.3, 0.55), box, vector), None)


def _mistaken(class_name: str, rng: np.random.Generator) -> str:
    """One of the three classes nearest in size, as detectors confuse things of a kind."""
    size = _size(class_name)
    others = sorted(
        (c for c in CLASSES if c != class_name), key=lambda c: (abs(_size(c) - size), c)
    )
    return others[int(rng.integers(0, 3))]


def _size(class_name: str) -> float:
    return max(m.width_m * m.height_m for m in MODELS.values() if m.class_name == class_name)


def _shaken(box: Box, rng: np.random.Generator) -> Box:
    x0, y0, x1, y1 = (edge + _BOX_NOISE_PX * normal(rng) for edge in box)
    return max(x0, 0.0), max(y0, 0.0), min(x1, float(WIDTH_PX)), min(y1, float(HEIGHT_PX))


def _fields(label: str, sure: float, box: Box, vector: NDArray[np.float32]) -> dict[str, Any]:
    return {
        "class": label,
        "confidence": round(max(0.3, min(0.99, sure)), 3),
        "bbox": [round(edge, 1) for edge in box],
        "embedding": base64.b64encode(vector.astype("<f4").tobytes()).decode("ascii"),
        "embedding_dim": DIM,
        "embedding_model": MODEL_NAME,
    }
