"""Estimates against a slow solution in rational numbers, and against where things stand."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold.sights import Sight
from projections.fold.spots import (
    COMMON_M2,
    LEAST_ELEVATION_M2,
    SIZE,
    SLOPE,
    Estimate,
    HeightPrior,
    Solver,
    Spots,
)
from projections.fold.thing_index import UNKNOWN_CLASS
from tests.support.thorough import examples

RANGE_M, RANGE_SPREAD = 3.0, 0.55


def _sight(
    x: float, y: float, to_x: float, to_y: float, height: float | None, elevation: float
) -> Sight:
    dx, dy = to_x - x, to_y - y
    far = math.hypot(dx, dy)
    log_height = None if height is None else math.log(height / far)
    side = dx / far, dy / far
    return Sight(x, y, *side, 0.0025, 0.0064, log_height, elevation / far, *side, None)


def _solved(sights: list[Sight], prior: HeightPrior = UNKNOWN_CLASS) -> tuple[Spots, Estimate]:
    solver, spots = Solver(RANGE_M, RANGE_SPREAD), Spots()
    estimate: Estimate | None = None
    for sight in sights:
        index = spots.add(sight, 1.0)
        if estimate is None:
            estimate = solver.first(spots, prior)
        else:
            estimate = solver.next(spots, prior, estimate, index)
    assert estimate is not None
    return spots, estimate


def _rational(spots: Spots, prior: HeightPrior, about: Estimate) -> list[Fraction]:
    """One Gauss-Newton step from ``about`` in the four unknowns x, y, log size, elevation, by
    Cramer's rule on dense normal equations: each measurement a row, nothing eliminated."""
    rows: list[tuple[list[float], float, float]] = [
        ([0.0, 0.0, 1.0, 0.0], prior.log_size, prior.log_size_weight),
        ([0.0, 0.0, 0.0, 1.0], prior.elevation, prior.elevation_weight),
    ]
    count = len(spots.spots)
    for px, py, cos, sin, per_m2, least, _, n, height, heights, slope, _, _ in spots.spots:
        along = max((about.x - px) * cos + (about.y - py) * sin, 0.3)
        across = (about.y - py) * cos - (about.x - px) * sin
        share = min(n, 1.5)
        variance = per_m2 * along**2 + least
        weight = share / variance / (1 + across**2 / (variance * 4))
        rows.append(([-sin, cos, 0.0, 0.0], cos * py - sin * px, weight))
        gx, gy = cos / along, sin / along
        aim = math.log(RANGE_M) - math.log(along) + gx * about.x + gy * about.y
        rows.append(([gx, gy, 0.0, 0.0], aim, min(1.0, 1.5 / count) / RANGE_SPREAD**2))
        if heights:
            share = min(heights, 1.5)
            value = height + math.log(along)
            weight = share / SIZE**2
            weight /= 1 + (value - about.log_size) ** 2 * weight / 4
            rows.append(([gx, gy, -1.0, 0.0], gx * about.x + gy * about.y - value, weight))
            weight = share / (SLOPE**2 * along**2 + LEAST_ELEVATION_M2)
            weight /= 1 + (along * slope - about.elevation) ** 2 * weight / 4
            ex, ey = slope * cos, slope * sin
            target = ex * about.x + ey * about.y - along * slope
            rows.append(([ex, ey, 0.0, -1.0], target, weight))
    normal = [[Fraction(0)] * 5 for _ in range(4)]
    for gradient, target, weight in rows:
        exact = [Fraction(g) for g in gradient]
        for i in range(4):
            for j in range(4):
                normal[i][j] += Fraction(weight) * exact[i] * exact[j]
            normal[i][4] += Fraction(weight) * exact[i] * Fraction(target)
    for i in range(4):
        pivot = normal[i][i]
        normal[i] = [value / pivot for value in normal[i]]
        for j in range(4):
            if j != i:
                factor = normal[j][i]
                normal[j] = [a - factor * b for a, b in zip(normal[j], normal[i], strict=True)]
    return [row[4] for row in normal]


_COORDINATE = st.floats(-5.0, 5.0)


@settings(deadline=None, max_examples=examples(60))
@given(
    st.lists(st.tuples(_COORDINATE, _COORDINATE, st.booleans()), min_size=1, max_size=9),
    st.integers(0, 1000),
)
def test_it_is_the_solution_of_the_normal_equations(
    seen_from: list[tuple[float, float, bool]], seed: int
) -> None:
    chance = np.random.default_rng(seed)
    sights = [
        _sight(x, y, *(8.0 + chance.normal(0, 0.1, 2)).tolist(), 0.8 if whole else None, -0.4)
        for x, y, whole in seen_from
    ]
    spots, estimate = _solved(sights)
    solver = Solver(RANGE_M, RANGE_SPREAD)
    again = solver.next(spots, UNKNOWN_CLASS, estimate, None)
    if math.hypot(again.x - estimate.x, again.y - estimate.y) >= 0.19:
        return  # it was linearised once more, at another point
    x, y, size, elevation = map(float, _rational(spots, UNKNOWN_CLASS, estimate))
    assert again.x == pytest.approx(x, abs=1e-7)
    assert again.y == pytest.approx(y, abs=1e-7)
    assert again.log_size == pytest.approx(size, abs=1e-7)
    assert again.elevation == pytest.approx(elevation, abs=1e-7)


def test_bearings_from_two_sides_meet_where_the_thing_stands() -> None:
    _, estimate = _solved([_sight(0, 0, 2, 2, None, 0.0), _sight(4, 0, 2, 2, None, 0.0)])
    assert math.hypot(estimate.x - 2, estimate.y - 2) < 0.05
    assert max(estimate.xx, estimate.yy) < 0.1


def test_looking_around_on_one_spot_is_no_triangulation() -> None:
    chance = np.random.default_rng(1)
    one = [_sight(0, 0, 4, 0, None, 0.0)]
    many = [
        _sight(*chance.normal(0, 0.02, 2).tolist(), 4, float(chance.normal(0, 0.1)), None, 0.0)
        for _ in range(12)
    ]
    _, first = _solved(one)
    spots, last = _solved(many)
    assert spots.seen_from == 1
    assert last.xx - COMMON_M2 > 0.6 * (first.xx - COMMON_M2)


def test_a_growing_box_tells_the_distance() -> None:
    """Driving straight at a thing, its bearing never changes."""
    with_boxes = [_sight(x, 0.0, 6.0, 0.0, 0.9, -0.5) for x in (0.0, 1.0, 2.0, 3.0, 4.0)]
    without = [sight._replace(log_height=None, slope=0.0) for sight in with_boxes]
    _, known = _solved(with_boxes)
    _, unknown = _solved(without)
    assert abs(known.x - 6.0) < 0.3
    assert known.xx < 0.25 * unknown.xx


def test_a_measured_depth_outweighs_the_usual_range() -> None:
    sight = _sight(0.0, 0.0, 5.0, 0.0, None, 0.0)._replace(measured=(5.0, 0.01))
    _, estimate = _solved([sight])
    assert estimate.x == pytest.approx(5.0, abs=0.1)
    assert estimate.xx - COMMON_M2 < 0.02
