"""The robot's camera and detector: visible objects, detections with faults, embeddings.

Camera: a pinhole looking straight ahead, 640 × 400 pixels, 69.4° wide. An object is visible when it
is in range, most of its box is in the picture, the box is not tiny, and no wall stands between the
camera and its middle or one of its sides. Furniture hides nothing.

Detector: it misses some objects, gets boxes wrong by a few pixels, is less confident of distant
objects, gives 4 % a wrong class (of about the same size), and detects something that is not there
in 2 % of the keyframes.

Embeddings, like CLIP's on object crops: the normalised sum of weighted unit vectors for what all
crops share, the class, the model (the same in every house), the instance, the side in view, the
session's light, and noise, each a named random direction. The weights are roots of the shares below
and were set so that cosines come out as measured on real crops (5th to 95th percentile): same
instance 0.82-0.92, same class but another instance 0.66-0.82, another class 0.48-0.58. Class
directions lie in a space of few dimensions, which makes some classes closer to each other than
others. The result is rounded to half precision, as a model run in fp16 gives it; rounding also
hides the last bits in which C libraries differ.
"""

import base64
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .drive import TruePose
from .floorplan import wrap
from .house import MODELS, House, SimulatedThing
from .random_streams import Vector, bernoulli, direction, normal, normals, stream, uniform, unit

WIDTH_PX, HEIGHT_PX = 640, 400
HFOV_DEG = 69.4
HFOV_RAD = math.radians(HFOV_DEG)
FOCAL_PX = WIDTH_PX / 2 / math.tan(HFOV_RAD / 2)
CAMERA_HEIGHT_M = 0.75
RANGE_M = (0.5, 5.0)
_MIN_SIDE_PX = 14.0
_MIN_SHOWN = 0.55
_NEAR_M = 0.15

Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class VisibleObject:
    """A thing in view: its exact box in pixels, its distance, and the side that the camera sees.

    ``side_rad`` is the direction from the thing to the camera, relative to the thing's front.
    """

    thing: SimulatedThing
    box: Box
    distance_m: float
    side_rad: float


def visible_objects(house: House, pose: TruePose) -> Iterator[VisibleObject]:
    """Everything the camera sees from ``pose``, in the order of ``house.things``."""
    for thing in house.things:
        x, y = thing.centre
        distance = math.hypot(x - pose.x, y - pose.y)
        if not RANGE_M[0] <= distance <= RANGE_M[1]:
            continue
        box = _clipped(_project(thing, pose))
        if box is not None and _unoccluded(house, thing, pose):
            side = wrap(math.atan2(pose.y - y, pose.x - x) - thing.facing_rad)
            yield VisibleObject(thing, box, distance, side)


def _project(thing: SimulatedThing, pose: TruePose) -> Box | None:
    """The box around the thing's eight corners, None when one is beside or behind the camera."""
    rect, cos, sin = thing.footprint, math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    heights = (thing.model.base_m, thing.model.base_m + thing.model.height_m)
    us: list[float] = []
    vs: list[float] = []
    for x in (rect.x0, rect.x1):
        for y in (rect.y0, rect.y1):
            ahead = (x - pose.x) * cos + (y - pose.y) * sin
            left = -(x - pose.x) * sin + (y - pose.y) * cos
            if ahead < _NEAR_M:
                return None
            us.append(WIDTH_PX / 2 - FOCAL_PX * left / ahead)
            vs += (HEIGHT_PX / 2 - FOCAL_PX * (h - CAMERA_HEIGHT_M) / ahead for h in heights)
    return min(us), min(vs), max(us), max(vs)


def _clipped(box: Box | None) -> Box | None:
    """The part of ``box`` in the picture; None when it is too small or too small a share."""
    if box is None:
        return None
    x0, y0, x1, y1 = box
    cut = max(x0, 0.0), max(y0, 0.0), min(x1, float(WIDTH_PX)), min(y1, float(HEIGHT_PX))
    wide, high = cut[2] - cut[0], cut[3] - cut[1]
    if wide < _MIN_SIDE_PX or high < _MIN_SIDE_PX:
        return None
    return cut if wide * high >= _MIN_SHOWN * (x1 - x0) * (y1 - y0) else None


def _unoccluded(house: House, thing: SimulatedThing, pose: TruePose) -> bool:
    x, y = thing.centre
    away = math.hypot(x - pose.x, y - pose.y)
    half = 0.4 * min(thing.model.width_m, thing.model.depth_m)
    across = (-(y - pose.y) / away * half, (x - pose.x) / away * half)
    targets = [(x, y), (x + across[0], y + across[1]), (x - across[0], y - across[1])]
    clear = [not house.walls.block((pose.x, pose.y), target) for target in targets]
    return sum(clear) >= 2


DIM = 512
MODEL_NAME = "mapfold-simulated-512"
_CLASS_SPACE = 160

_SHARES = {
    "common": 0.512,
    "class": 0.163,
    "model": 0.080,
    "instance": 0.090,
    "side": 0.045,
    "session": 0.033,
    "noise": 0.084,
}
_WEIGHTS = {part: math.sqrt(share) for part, share in _SHARES.items()}


def embed(
    class_name: str,
    model: str,
    instance: str,
    side_rad: float,
    session: str,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """The embedding of one crop, a unit vector (to half precision), float32 of shape (512,)."""
    front, flank = _named_direction("side-front", model), _named_direction("side-flank", model)
    total = (
        _WEIGHTS["common"] * _named_direction("common")
        + _WEIGHTS["class"] * _class_direction(class_name)
        + _WEIGHTS["model"] * _named_direction("model", model)
        + _WEIGHTS["instance"] * _named_direction("instance", instance)
        + _WEIGHTS["side"] * (math.cos(side_rad) * front + math.sin(side_rad) * flank)
        + _WEIGHTS["session"] * _named_direction("session", session)
        + _WEIGHTS["noise"] * unit(normals(rng, DIM))
    )
    return unit(total).astype(np.float16).astype(np.float32)


@cache
def _named_direction(*words: str) -> Vector:
    return direction(stream("embedding", *words), DIM)


@cache
def _class_direction(class_name: str) -> Vector:
    """A mix of a few shared directions, so that classes are correlated like real ones."""
    mix = normals(stream("embedding", "class", class_name), _CLASS_SPACE)
    total = np.zeros(DIM)
    for index, weight in enumerate(mix.tolist()):
        total = total + weight * _named_direction("class axis", str(index))
    return unit(total)


MISS_RATE = 0.08
WRONG_LABEL_RATE = 0.04
FALSE_POSITIVE_RATE = 0.02
_BOX_NOISE_PX = 4.0

CLASSES = tuple(sorted({model.class_name for model in MODELS.values()}))


@dataclass(frozen=True, slots=True)
class SimulatedDetection:
    """The fields of a detection in the envelope, without its id, and the true instance, None for a
    phantom."""

    fields: dict[str, Any]
    instance: str | None


def detect(
    objects: Iterator[VisibleObject], session: str, rng: np.random.Generator
) -> Iterator[SimulatedDetection]:
    """The detections of one keyframe."""
    for visible in objects:
        if not bernoulli(rng, MISS_RATE):
            yield _detection(visible, session, rng)
    if bernoulli(rng, FALSE_POSITIVE_RATE):
        yield _phantom(session, rng)


def _detection(
    visible: VisibleObject, session: str, rng: np.random.Generator
) -> SimulatedDetection:
    model, instance = visible.thing.model, visible.thing.instance
    vector = embed(model.class_name, model.name, instance, visible.side_rad, session, rng)
    label = (
        _wrong_class(model.class_name, rng)
        if bernoulli(rng, WRONG_LABEL_RATE)
        else model.class_name
    )
    confidence = 0.93 - 0.22 * visible.distance_m / RANGE_M[1] + 0.06 * normal(rng)
    if label != model.class_name:
        confidence -= 0.25
    return SimulatedDetection(
        _fields(label, confidence, _noisy_box(visible.box, rng), vector), instance
    )


def _phantom(session: str, rng: np.random.Generator) -> SimulatedDetection:
    label = CLASSES[int(rng.integers(0, len(CLASSES)))]
    phantom = f"phantom-{int(rng.integers(0, 2**62))}"
    x, y = uniform(rng, 0, WIDTH_PX - 120), uniform(rng, 0, HEIGHT_PX - 120)
    box = (x, y, x + uniform(rng, 30, 120), y + uniform(rng, 30, 120))
    vector = embed(label, phantom, phantom, 0.0, session, rng)
    return SimulatedDetection(_fields(label, uniform(rng, 0.3, 0.55), box, vector), None)


def _wrong_class(class_name: str, rng: np.random.Generator) -> str:
    """One of the three classes nearest in size."""
    size = _size(class_name)
    others = sorted(
        (c for c in CLASSES if c != class_name), key=lambda c: (abs(_size(c) - size), c)
    )
    return others[int(rng.integers(0, 3))]


def _size(class_name: str) -> float:
    return max(m.width_m * m.height_m for m in MODELS.values() if m.class_name == class_name)


def _noisy_box(box: Box, rng: np.random.Generator) -> Box:
    x0, y0, x1, y1 = (edge + _BOX_NOISE_PX * normal(rng) for edge in box)
    return max(x0, 0.0), max(y0, 0.0), min(x1, float(WIDTH_PX)), min(y1, float(HEIGHT_PX))


def _fields(label: str, confidence: float, box: Box, vector: NDArray[np.float32]) -> dict[str, Any]:
    return {
        "class": label,
        "confidence": round(max(0.3, min(0.99, confidence)), 3),
        "bbox": [round(edge, 1) for edge in box],
        "embedding": base64.b64encode(vector.astype("<f4").tobytes()).decode("ascii"),
        "embedding_dim": DIM,
        "embedding_model": MODEL_NAME,
    }
