"""Exact arithmetic: correct rounding, and its bounds."""

import math
from decimal import ROUND_HALF_EVEN, Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from projections.fold.exact import (
    MAX_DIMENSION,
    Q40,
    UNIT,
    dot_of_sums,
    long_dot,
    mean_m,
    metres_to_um,
    quantise,
    quantise_rows,
    to_float32,
    unit_rows,
    unit_vectors,
)

FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False)
VECTORS = arrays(np.float32, st.sampled_from([1, 2, 3, 512]), elements=FINITE).filter(np.any)


@given(st.floats(-1e7, 1e7))
def test_micrometres_are_the_nearest_integer_to_the_floats_value(metres: float) -> None:
    exact = Decimal(metres).scaleb(6).quantize(Decimal(1), ROUND_HALF_EVEN)
    assert metres_to_um(metres) == int(exact)


@pytest.mark.parametrize(
    ("metres", "um"), [(2.14, 2_140_000), (-0.0, 0), (0.5e-6, 0), (1e7, 10**13), (-2.5e-6, -3)]
)
def test_micrometres_by_hand(metres: float, um: int) -> None:
    """-2.5e-6 is a little more than its decimal says."""
    assert metres_to_um(metres) == um


@given(st.integers(-(10**19), 10**19), st.integers(1, 10**6))
def test_means_are_correctly_rounded(total: int, count: int) -> None:
    assert mean_m(total, count) == float(Decimal(total) / (Decimal(count) * 10**6)) or math.isclose(
        mean_m(total, count), total / count / 1e6, rel_tol=1e-15
    )


@given(VECTORS)
def test_a_quantised_vector_points_the_same_way(vector: np.ndarray) -> None:
    unit = quantise(vector)
    assert unit.dtype == np.int32
    assert np.abs(unit).max() <= UNIT
    wide = vector.astype(np.longdouble)
    expected = wide / np.sqrt((wide * wide).sum())
    # With its largest component M >= 2**19, rounding each moves a component by 1/2, and the norm by
    # the sum of x/2 over the norm: of the largest component, with the others' norm S, that is up to
    # M (M + sqrt(n - 1) S) / 2 / (M² + S²)^1.5 <= (1/2 + 0.1925 sqrt(n - 1)) / M.
    by_norm = 0.5 + 0.1925 * math.sqrt(len(vector) - 1)
    assert np.abs(unit / UNIT - expected).max() < (0.5 + by_norm) / 2**19 + 0.5 / UNIT
    assert abs(sum(int(x) ** 2 for x in unit) / Q40 - 1) < 2.0**-12


@given(VECTORS, st.integers(-100, 100))
def test_scaling_by_a_power_of_two_changes_nothing(vector: np.ndarray, power: int) -> None:
    with np.errstate(over="ignore", under="ignore"):
        scaled = np.ldexp(vector, power).astype(np.float32)
    if np.array_equal(np.ldexp(scaled.astype(float), -power), vector.astype(float)):
        assert np.array_equal(quantise(scaled), quantise(vector))


@given(st.lists(arrays(np.float32, 7, elements=FINITE).filter(np.any), min_size=1, max_size=5))
def test_a_row_does_not_depend_on_its_neighbours(vectors: list[np.ndarray]) -> None:
    together = quantise_rows(np.array(vectors))
    assert all(np.array_equal(quantise(v), row) for v, row in zip(vectors, together, strict=True))


def test_vectors_of_several_dimensions_and_none() -> None:
    vectors = [np.ones(3, np.float32), None, np.array([0, 2], np.float32), np.ones(3, np.float32)]
    units = unit_vectors(vectors)
    assert units[1] is None
    for vector, unit in zip(vectors, units, strict=True):
        if vector is not None and unit is not None:
            wide, narrow, norm2 = unit
            assert np.array_equal(narrow, quantise(vector))
            assert np.array_equal(wide, narrow)
            assert norm2 == sum(int(x) ** 2 for x in narrow)


@given(VECTORS)
def test_float32_holds_a_unit_vector_exactly(vector: np.ndarray) -> None:
    unit = quantise(vector)
    assert np.array_equal(to_float32(unit).astype(float) * UNIT, unit)


@given(st.data())
def test_the_cosine_is_exact_whatever_the_order(data: st.DataObject) -> None:
    vectors = arrays(np.float32, 64, elements=FINITE).filter(np.any)
    a, b = unit_rows(np.array([data.draw(vectors), data.draw(vectors)]))
    exact = sum(int(x) * int(y) for x, y in zip(a, b, strict=True))
    order = np.random.default_rng(0).permutation(64)
    assert np.dot(a, b) == np.dot(a[order], b[order]) == exact


@pytest.mark.parametrize("count", [1, 4097, 1 << 22, 1 << 23, 1 << 31, 1 << 32])
@pytest.mark.parametrize("dim", [1, 2, 512, 16_000])
def test_the_product_of_a_long_sum_is_that_of_python_integers(count: int, dim: int) -> None:
    rng = np.random.default_rng(dim)
    first, unit = unit_rows(rng.normal(size=(2, dim)))
    for total in (count * first, -count * first, count * unit + 1):
        expected = sum(int(a) * int(b) for a, b in zip(total, unit, strict=True))
        assert long_dot(total, unit) == expected


@pytest.mark.parametrize(
    "counts", [(64, 64), (65, 64), (1 << 28, 16), (16, 1 << 28), (1 << 20, 40)]
)
@pytest.mark.parametrize("dim", [1, 512, 16_000])
def test_the_product_of_two_sums_is_that_of_python_integers(
    counts: tuple[int, int], dim: int
) -> None:
    rng = np.random.default_rng(dim)
    first, second = unit_rows(rng.normal(size=(2, dim)))
    for unit in (first, second):
        sums = [counts[0] * first + 1, counts[1] * unit]
        expected = sum(int(a) * int(b) for a, b in zip(*sums, strict=True))
        assert dot_of_sums(sums[0], counts[0], sums[1], counts[1]) == expected


def test_the_largest_dimension_keeps_its_sums_exact() -> None:
    """All components at the bound: the squares' sum is still below 2⁵³."""
    vector = np.full(MAX_DIMENSION, np.nextafter(np.float32(2), np.float32(0)), np.float32)
    unit = quantise(vector)
    assert set(unit.tolist()) == {round(UNIT / math.sqrt(MAX_DIMENSION))}
    with pytest.raises(ValueError, match="beyond"):
        quantise(np.ones(MAX_DIMENSION + 1, np.float32))
