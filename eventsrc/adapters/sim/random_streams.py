"""Named random streams: each decision has its own, so that its draws do not shift those of others.

A stream is PCG64 seeded with the SHA-256 of its name's words. Directions and noise are sums of
integers (Irwin-Hall, close enough to normal): unlike numpy's normal variates they use no
logarithm or exponential of the platform's C library, so they are equal everywhere.
"""

import hashlib
import math

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

_SUMMANDS = 6
_SPAN = 2048
_SIGMA = math.sqrt(_SUMMANDS * ((2 * _SPAN) ** 2 - 1) / 12.0)


def stream(*words: object) -> np.random.Generator:
    """The generator named by ``words``; equal words give equal numbers."""
    name = "\x1f".join(str(word) for word in words)
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest(), "big")
    return np.random.Generator(np.random.PCG64(seed))


def normals(rng: np.random.Generator, count: int) -> Vector:
    """``count`` nearly normal numbers of mean 0 and variance 1, shape (count,)."""
    drawn = rng.integers(-_SPAN, _SPAN, size=(_SUMMANDS, count))
    sums: Vector = (drawn.sum(axis=0) + _SUMMANDS / 2) / _SIGMA
    return sums


def normal(rng: np.random.Generator) -> float:
    """One nearly normal number of mean 0 and variance 1."""
    return float(normals(rng, 1)[0])


def uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number in [low, high), a multiple of 2⁻³² of the span."""
    return low + (high - low) * (int(rng.integers(0, 2**32)) / 2**32)


def bernoulli(rng: np.random.Generator, probability: float) -> bool:
    """True with probability ``probability``."""
    return uniform(rng, 0.0, 1.0) < probability


def unit(vector: Vector) -> Vector:
    """``vector`` scaled to length 1; the sum is correctly rounded on any hardware."""
    length = math.sqrt(math.fsum((vector * vector).tolist()))
    scaled: Vector = vector / length
    return scaled


def direction(rng: np.random.Generator, dim: int) -> Vector:
    """A random unit vector of shape (dim,)."""
    return unit(normals(rng, dim))
