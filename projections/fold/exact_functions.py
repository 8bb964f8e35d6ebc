"""Sine, cosine, arc tangent, exponential and logarithm with the same bits on every machine.

A platform's libm may differ from another in the last bit, so the fold calls none of it. These are
the methods of fdlibm (Sun Microsystems, 1993: s_sin.c, s_atan.c, e_exp.c, e_log.c), written with
+, −, ×, ÷ of two float64, rounding to an integer, and scaling by powers of two only, which IEEE 754
defines to the last bit. They are right within two units in the last place in the domain that each
one states; beyond it they are the same everywhere, but less accurate.
"""

import math

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
