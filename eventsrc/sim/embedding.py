"""Embeddings that behave like CLIP's on object crops, made of named random directions.

One crop's embedding is the normalised sum of weighted unit vectors: what all crops share, the
class, the model (the same in every house), the instance, the side that shows, the session's light,
and noise. The weights are roots of the shares below and were set so that cosines come out as
measured on real crops (5th to 95th percentile): same instance 0.82-0.92, same class but another
instance 0.66-0.82, another class 0.48-0.58. Class directions lie in a space of few dimensions,
which is what makes some classes closer to each other than others.

The result is rounded to half precision, as a model run in fp16 gives it; rounding also hides the
last bits in which C libraries differ.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from .chance import Vector, direction, normals, stream, unit

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
    front, flank = _named("side-front", model), _named("side-flank", model)
    total = (
        _WEIGHTS["common"] * _named("common")
        + _WEIGHTS["class"] * _class_direction(class_name)
        + _WEIGHTS["model"] * _named("model", model)
        + _WEIGHTS["instance"] * _named("instance", instance)
        + _WEIGHTS["side"] * (math.cos(side_rad) * front + math.sin(side_rad) * flank)
        + _WEIGHTS["session"] * _named("session", session)
        + _WEIGHTS["noise"] * unit(normals(rng, DIM))
    )
    return unit(total).astype(np.float16).astype(np.float32)


@cache
def _named(*words: str) -> Vector:
    return direction(stream("embedding", *words), DIM)


@cache
def _class_direction(class_name: str) -> Vector:
    """A mix of a few shared directions, so that classes are correlated like real ones."""
    mix = normals(stream("embedding", "class", class_name), _CLASS_SPACE)
    total = np.zeros(DIM)
    for index, weight in enumerate(mix.tolist()):
        total = total + weight * _named("class axis", str(index))
    return unit(total)
