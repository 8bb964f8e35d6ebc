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

A platform's libm may differ from another in the last bit, so the fold calls none of it. `cos_sin`,
`atan`, `exp` and `log` are the methods of fdlibm (Sun Microsystems, 1993: s_sin.c, s_atan.c,
e_exp.c, e_log.c), of +, −, ×, ÷ of two float64, rounding to an integer and scaling only. They are
right within two units in the last place in the domain that each one states; beyond it they
are the same everywhere, but less accurate.
"""

import math
from collections.abc import Sequence
from operator import mul
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

UnitVector: TypeAlias = NDArray[np.int32]
"""A unit vector as multiples of 2⁻²⁰, int32 of shape (dim,)."""

_TWO_OVER_PI = 6.36619772367581382433e-01
_HALF_PI = 1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21
"""π/2 in three parts; a multiple of the first two of up to 2²⁰ is exact."""
_SIN = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
_COS = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)
_ATAN = (
    1.62858201153657823623e-02,
    -3.65315727442169155270e-02,
    4.97687799461593236017e-02,
    -5.83357013379057348645e-02,
    6.66107313738753120669e-02,
    -7.69187620504482999495e-02,
    9.09088713343650656196e-02,
    -1.11111104054623557880e-01,
    1.42857142725034663711e-01,
    -1.99999999998764832476e-01,
    3.33333333333329318027e-01,
)
_ATAN_AT = (
    # arc tangent of 1/2, 1, 3/2 and infinity, each in two parts
    (4.63647609000806093515e-01, 2.26987774529616870924e-17),
    (7.85398163397448278999e-01, 3.06161699786838301793e-17),
    (9.82793723247329054082e-01, 1.39033110312309984516e-17),
    (1.57079632679489655800e00, 6.12323399573676603587e-17),
)
_EXP = (
    4.13813679705723846039e-08,
    -1.65339022054652515390e-06,
    6.61375632143793436117e-05,
    -2.77777777770155933842e-03,
    1.66666666666666019037e-01,
)
_LOG = (
    1.479819860511658591e-01,
    1.531383769920937332e-01,
    1.818357216161805012e-01,
    2.222219843214978396e-01,
    2.857142874366239149e-01,
    3.999999999940941908e-01,
    6.666666666666735130e-01,
)
_LN2 = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_LOG2_E = 1.44269504088896338700e00
_SQRT_HALF = 0.7071067811865476
_MAX_EXP, _MIN_EXP = 709.0, -708.0


def cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle in radians, accurate for |angle| up to 10⁶."""
    quarters = float(round(angle * _TWO_OVER_PI))
    first, second, third = _HALF_PI
    rest = (angle - quarters * first) - quarters * second
    low = quarters * third
    x = rest - low
    low = (rest - x) - low
    square = x * x
    s0, s1, s2, s3, s4, s5 = _SIN
    p = (((s0 * square + s1) * square + s2) * square + s3) * square + s4
    cube = square * x
    sine = x - ((square * (0.5 * low - cube * p) - low) - cube * s5)
    c0, c1, c2, c3, c4, c5 = _COS
    q = ((((c0 * square + c1) * square + c2) * square + c3) * square + c4) * square + c5
    half = 0.5 * square
    one = 1.0 - half
    cosine = one + (((1.0 - one) - half) + (square * square * q - x * low))
    turn = int(quarters) & 3
    if turn == 0:
        return cosine, sine
    if turn == 1:
        return -sine, cosine
    if turn == 2:
        return -cosine, -sine
    return sine, -cosine


def atan(x: float) -> float:
    """Arc tangent, in radians, of any finite number."""
    size = abs(x)
    if size < 0.4375:
        high, low, t = 0.0, 0.0, size
    elif size < 0.6875:
        (high, low), t = _ATAN_AT[0], (2.0 * size - 1.0) / (2.0 + size)
    elif size < 1.1875:
        (high, low), t = _ATAN_AT[1], (size - 1.0) / (size + 1.0)
    elif size < 2.4375:
        (high, low), t = _ATAN_AT[2], (size - 1.5) / (1.0 + 1.5 * size)
    else:
        (high, low), t = _ATAN_AT[3], -1.0 / size
    square = t * t
    p = 0.0
    for coefficient in _ATAN:
        p = p * square + coefficient
    angle = high - ((t * square * p - low) - t)
    return -angle if x < 0.0 else angle


def exp(x: float) -> float:
    """e to the x: 0 below −708, and e⁷⁰⁹ above 709."""
    if x < _MIN_EXP:
        return 0.0
    if x > _MAX_EXP:
        x = _MAX_EXP
    twos = round(x * _LOG2_E)
    high = x - twos * _LN2[0]
    low = twos * _LN2[1]
    rest = high - low
    square = rest * rest
    e0, e1, e2, e3, e4 = _EXP
    p = (((e0 * square + e1) * square + e2) * square + e3) * square + e4
    c = rest - square * p
    return math.ldexp(1.0 - ((low - (rest * c) / (2.0 - c)) - high), twos)


def log(x: float) -> float:
    """Natural logarithm of a positive finite number."""
    if x <= 0.0:
        raise ValueError(f"the logarithm of {x!r}: it must be above 0")
    mantissa, twos = math.frexp(x)
    if mantissa < _SQRT_HALF:
        mantissa, twos = mantissa * 2.0, twos - 1
    f = mantissa - 1.0
    s = f / (2.0 + f)
    square = s * s
    l0, l1, l2, l3, l4, l5, l6 = _LOG
    p = ((((l0 * square + l1) * square + l2) * square + l3) * square + l4) * square + l5
    p = (p * square + l6) * square
    half = 0.5 * f * f
    return twos * _LN2[0] - ((half - (s * (half + p) + twos * _LN2[1])) - f)


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
_FEW = 16
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
    np.rint(scaled, out=scaled)
    scaled += 0.0  # makes -0.0 the 0.0 that an integer is
    return scaled


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


def dot_of_sums(
    one: NDArray[np.float64], count: int, other: NDArray[np.float64], other_count: int
) -> int:
    """The exact product of two sums of ``count`` and ``other_count`` unit vectors, of shape (dim,)
    both."""
    if count < other_count:
        return dot_of_sums(other, other_count, one, count)
    if count * other_count <= MAX_IN_ONE_DOT:
        return int(one.dot(other))
    if other_count <= _FEW and count * other_count <= MAX_IN_A_SUM:
        return long_dot(one, other)  # neither product reaches 2⁵³ either
    return sum(map(mul, map(int, one.tolist()), map(int, other.tolist())))


def distance_um(ax: int, ay: int, bx: int, by: int) -> int:
    """The distance of two points, rounded down to whole micrometres."""
    dx, dy = ax - bx, ay - by
    return math.isqrt(dx * dx + dy * dy)


def log_of(value: float) -> float:
    """`logs` of one number, to the last bit."""
    mantissa, twos = math.frexp(value)
    s = (mantissa - 0.7071067811865476) / (mantissa + 0.7071067811865476)
    square = s * s
    series = (square * 0.4 + 2.0 / 3.0) * square + 2.0
    return (twos - 0.5) * 0.6931471805599453 + s * series


def logs(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Natural logarithms of positive numbers, right to some 10⁻⁵, the same bits everywhere."""
    mantissas, twos = np.frexp(values)
    s = mantissas - 0.7071067811865476
    mantissas += 0.7071067811865476
    s /= mantissas
    square = s * s
    series = square * 0.4
    series += 2.0 / 3.0
    series *= square
    series += 2.0
    series *= s
    result: NDArray[np.float64] = twos - 0.5
    result *= 0.6931471805599453
    result += series
    return result
