"""Lines of sight and angles against exact arithmetic."""

import math
from fractions import Fraction

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from eventsrc.adapters.sim.floorplan import Point, Rect, Segment, Walls, rect_clearance, wrap

# Quarters: exact in floating point, so that only the method is under test, not the rounding.
coordinates = st.integers(-40, 40).map(lambda n: n / 4)
points = st.tuples(coordinates, coordinates)


def _turn(a: Point, b: Point, c: Point) -> int:
    ax, ay, bx, by, cx, cy = map(Fraction, (*a, *b, *c))
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    return (area > 0) - (area < 0)


def _cross_exactly(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether two segments that are not parallel share a point, by four orientations."""
    return _turn(a, b, c) * _turn(a, b, d) <= 0 and _turn(c, d, a) * _turn(c, d, b) <= 0


@given(points, points, st.lists(st.tuples(points, points), min_size=1, max_size=5))
def test_a_sight_is_blocked_exactly_when_it_crosses_a_wall(
    a: Point, b: Point, walls: list[tuple[Point, Point]]
) -> None:
    assume(a != b)
    for c, d in walls:
        assume((b[0] - a[0]) * (d[1] - c[1]) != (b[1] - a[1]) * (d[0] - c[0]))
    expected = any(_cross_exactly(a, b, c, d) for c, d in walls)
    assert Walls([Segment(*c, *d) for c, d in walls]).block(a, b) == expected


@given(points, st.tuples(points, points))
def test_clearance_is_the_distance_to_the_nearest_point_of_the_wall(
    spot: Point, wall: tuple[Point, Point]
) -> None:
    (c, d) = wall
    steps = [
        math.dist(spot, (c[0] + (d[0] - c[0]) * k / 400, c[1] + (d[1] - c[1]) * k / 400))
        for k in range(401)
    ]
    found = float(Walls([Segment(*c, *d)]).clearance(np.array([spot]))[0])
    assert found <= min(steps) + 1e-9
    assert found >= min(steps) - math.dist(c, d) / 400


@given(points, points, points)
def test_rect_clearance_agrees_with_clamping(spot: Point, a: Point, b: Point) -> None:
    rect = Rect(min(a[0], b[0]), min(a[1], b[1]), max(a[0], b[0]), max(a[1], b[1]))
    nearest = (min(max(spot[0], rect.x0), rect.x1), min(max(spot[1], rect.y0), rect.y1))
    assert float(rect_clearance(rect, np.array([spot]))[0]) == math.dist(spot, nearest)


@given(st.floats(-1e6, 1e6))
def test_wrap_keeps_the_direction_and_lands_in_half_a_turn(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-6)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-6)
