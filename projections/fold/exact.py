"""Arithmetic that gives the same bits on every machine, thread count and BLAS.

Floating-point sums depend on their order, and every BLAS kernel has its own. So only integers are
summed here whose sums, partial ones included, are below 2⁵³ in magnitude: these are exact in
float64 (and in int64), whatever their order. What must be rounded is rounded by the operations that
IEEE 754 defines to the last bit: +, ×, ÷ of two numbers, √, rint, and scaling by a power of two.

Unit vectors are int32 multiples of 2⁻²⁰ (``UnitVector``). To make one, the float32 components are
scaled by the power of two that brings the largest below 2²⁰ and rounded to integers; their squares
add up to at most dim · 2⁴⁰, below 2⁵³ up to 2¹² dimensions; beyond, up to 2¹⁴, the components get
fewer bits (`_component_bits`). The norm is the square root of that exact sum.

Products of two unit vectors are multiples of 2⁻⁴⁰ (``_q40``). By Cauchy and Schwarz every partial
sum is at most |a||b| ≈ 2⁴⁰, far below 2⁵³; with a sum of n unit vectors it is at most n · 2⁴⁰, for
which up to 2¹² of them one product is enough, and two up to 2³² (`long_dot`).

Positions are integer micrometres, correctly rounded from the float that came; ±10¹³ (10,000 km,
guarded by the envelope). Squared distances reach 8·10²⁶, so they are Python integers, never int64,
unless the caller has bounded the difference first.
"""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .deltas import UnitVector

Units: TypeAlias = tuple[NDArray[np.float64], UnitVector, int]
"""A unit vector in float64 and in int32, the same multiples of 2⁻²⁰, and its exact squared norm, a
multiple of 2⁻⁴⁰ near 1."""

UNIT_BITS = 20
UNIT = 1 << UNIT_BITS
Q40 = 1 << (2 * UNIT_BITS)
UM_PER_M = 1_000_000
MAX_DIMENSION = 16_384
MAX_IN_ONE_DOT = 1 << 12
MAX_IN_A_SUM = 1 << 32
"""Unit vectors; a component of their sum, a little over 2³² · 2²⁰ at most, is below 2⁵³. At ten
observations of one object a second, that is thirteen years."""
_HALF_BITS = 21
_SAFE_UM = 1e12


def metres_to_um(metres: float) -> int:
    """The nearest integer micrometre to the float's exact value; ties go to the even one."""
    scaled = metres * 1e6
    nearest = round(scaled)
    if abs(scaled) < _SAFE_UM and abs(scaled - nearest) < 0.49:
        return nearest  # the product's rounding error, below 2⁻¹³, cannot reach the tie at 0.5
    numerator, denominator = metres.as_integer_ratio()
    floor, rest = divmod(numerator * UM_PER_M, denominator)
    return floor + (2 * rest > denominator or (2 * rest == denominator and floor % 2 == 1))


def mean_m(sum_um: int, count: int) -> float:
    """The mean of ``count`` positions in metres, correctly rounded; 0.0 for none."""
    return sum_um / (count * UM_PER_M) if count else 0.0


def quantise(vector: NDArray[np.float32]) -> UnitVector:
    """The unit vector of a finite, non-zero float32 vector of shape (dim,), dim ≤ 16,384."""
    unit: UnitVector = quantise_rows(vector[np.newaxis])[0]
    return unit


def quantise_rows(rows: NDArray[np.float32]) -> NDArray[np.int32]:
    """`quantise` for each row of shape (n, dim) at once; n rows cost little more than one."""
    return unit_rows(rows).astype(np.int32)


def unit_rows(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """`quantise_rows` as float64, which holds the same integers and multiplies faster."""
    dim = rows.shape[1]
    if dim > MAX_DIMENSION:
        raise ValueError(f"an embedding of {dim} dimensions is beyond {MAX_DIMENSION}")
    # frexp and ldexp only move exponents; √, ÷ and rint are correctly rounded, in numpy as in C.
    exponents = np.frexp(np.abs(rows).max(axis=1))[1]
    scaled = rows.astype(np.float64)
    scaled *= np.ldexp(1.0, _component_bits(dim) - exponents)[:, np.newaxis]
    np.rint(scaled, out=scaled)
    scaled *= (UNIT / np.sqrt(squared_norms(scaled)))[:, np.newaxis]
    return np.rint(scaled, out=scaled)


def squared_norms(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """The exact squared norm of each row of integers, shape (n,); each must be below 2⁵³."""
    norms: NDArray[np.float64] = np.einsum("ij,ij->i", rows, rows)
    return norms


def unit_vectors(vectors: Sequence[NDArray[np.float32] | None]) -> list[Units | None]:
    """The `Units` of each vector, None for None. Many at once take less time than one by one; the
    result for a vector does not depend on the others."""
    units: list[Units | None] = [None] * len(vectors)
    for dim in sorted({len(vector) for vector in vectors if vector is not None}):
        indices = [i for i, v in enumerate(vectors) if v is not None and len(v) == dim]
        wide = unit_rows(np.array([vectors[i] for i in indices]))
        norms: list[float] = squared_norms(wide).tolist()
        made = zip(wide, wide.astype(np.int32), map(int, norms), strict=True)
        if len(indices) == len(vectors):
            return list(made)
        for i, unit in zip(indices, made, strict=True):
            units[i] = unit
    return units


def _component_bits(dim: int) -> int:
    """Bits of a component so that dim squares of them stay below 2⁵³."""
    return min(UNIT_BITS, (52 - (dim - 1).bit_length()) // 2)


def to_float32(unit: UnitVector) -> NDArray[np.float32]:
    """The unit vector as float32, exactly: 21 bits fit the 24 of a float32."""
    return unit.astype(np.float32) * np.float32(1.0 / UNIT)


def long_dot(vector_sum: NDArray[np.float64], unit: NDArray[np.float64]) -> int:
    """The exact product of a unit vector and a sum S of up to 2³² of them, of shape (dim,) both.

    Plain ``dot`` is exact up to ``MAX_IN_ONE_DOT`` of them. Beyond, S = 2²¹ H + L with 0 ≤ L < 2²¹:
    |S| is at most a little over 2⁵², so |H| is about 2³¹, and |L| below 2²¹ · √dim; with
    |unit| ≈ 2²⁰ neither product reaches 2⁵².
    """
    high = np.floor(np.ldexp(vector_sum, -_HALF_BITS))
    low = vector_sum - np.ldexp(high, _HALF_BITS)
    return (int(high.dot(unit)) << _HALF_BITS) + int(low.dot(unit))


def distance_um(ax: int, ay: int, bx: int, by: int) -> int:
    """The distance of two points, rounded down to whole micrometres."""
    return math.isqrt((ax - bx) ** 2 + (ay - by) ** 2)
