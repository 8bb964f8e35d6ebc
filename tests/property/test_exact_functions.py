"""Functions with the same bits everywhere: within two units in the last place of the platform's
own, which may itself be off by one, and equal to bits that were written down."""

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.exact import atan, cos_sin, exp, log

_ANGLES = st.floats(-1e6, 1e6)
_KNOWN = [
    (cos_sin, 0.7, ("0x1.87996529f9d93p-1", "0x1.49d6e694619b8p-1")),
    (cos_sin, -2.5, ("-0x1.9a2f7ef858b7dp-1", "-0x1.326af0dcfcab0p-1")),
    (cos_sin, 100.25, ("0x1.ebec72ba6b0ecp-1", "-0x1.1bf00980dc35dp-2")),
    (cos_sin, math.pi, ("-0x1.0000000000000p+0", "0x1.1a62633145c07p-53")),
    (atan, 0.3, ("0x1.2a73a661eaf06p-2",)),
    (atan, -5.5, ("-0x1.6414d44094c7cp+0",)),
    (exp, 1.1, ("0x1.808883244d593p+1",)),
    (exp, -20.3, ("0x1.a3b8dc86d1c8ep-30",)),
    (log, 10.0, ("0x1.26bb1bbb55516p+1",)),
    (log, 0.013, ("-0x1.15f0883f73978p+2",)),
]


def _ulps(value: float, right: float) -> float:
    return abs(value - right) / math.ulp(right)


@given(_ANGLES)
def test_cosine_and_sine(angle: float) -> None:
    cosine, sine = cos_sin(angle)
    assert _ulps(cosine, math.cos(angle)) <= 2
    assert _ulps(sine, math.sin(angle)) <= 2


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_arc_tangent(x: float) -> None:
    assert _ulps(atan(x), math.atan(x)) <= 2


@given(st.floats(-700.0, 700.0))
def test_exponential(x: float) -> None:
    assert _ulps(exp(x), math.exp(x)) <= 2


@given(st.floats(5e-324, 1.7e308))
def test_logarithm(x: float) -> None:
    assert abs(log(x) - math.log(x)) <= 2 * max(math.ulp(math.log(x)), 2.0**-53 * abs(x - 1.0))


def test_ends_of_the_domains() -> None:
    assert cos_sin(0.0) == (1.0, 0.0)
    assert exp(-1e9) == 0.0
    assert exp(1e9) == exp(709.0)
    assert exp(0.0) == 1.0
    assert log(1.0) == 0.0
    for bad in (0.0, -1.0):
        with pytest.raises(ValueError, match="must be above 0"):
            log(bad)


@pytest.mark.parametrize(("function", "x", "bits"), _KNOWN)
def test_bits_that_were_written_down(
    function: Callable[[float], Any], x: float, bits: tuple[str, ...]
) -> None:
    made = function(x)
    values = made if isinstance(made, tuple) else (made,)
    assert tuple(value.hex() for value in values) == bits
