"""Landmarks from points along rays: clusters, positions and their covariances."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.relocalize.landmarks import Points, cluster_points, estimate_position, points_of
from projections.relocalize.model import MODEL

Spot = tuple[float, float]


def seen(things: Sequence[Spot], origins: Sequence[Spot], stretch: float = 1.0) -> Points:
    """Every thing from every origin, the range wrong by the factor ``stretch``."""
    pairs = [(origin, thing) for thing in things for origin in origins]
    origin = np.array([pair[0] for pair in pairs])
    ray = stretch * (np.array([pair[1] for pair in pairs]) - origin)
    return points_of(origin, ray, np.zeros(len(pairs), dtype=bool), MODEL.sigma_size_least, MODEL)


def test_neighbours_half_a_metre_apart_are_two_things() -> None:
    """A circle wide enough for the errors along the rays would merge them."""
    origins = [(0.0, 0.0), (0.2, 0.0), (0.4, 0.0)]
    points = seen([(-0.25, 3.0), (0.35, 3.0)], origins)
    groups = cluster_points(points, np.ones(6), 9, MODEL)
    assert sorted(sorted(group.tolist()) for group in groups) == [[0, 1, 2], [3, 4, 5]]


def test_crossing_bearings_give_the_position_though_the_range_is_wrong() -> None:
    """Two views square to each other, ranges a tenth too long: the crossing is nearer."""
    points = seen([(0.0, 0.0)], [(3.0, 0.0), (0.0, 3.0)], stretch=1.1)
    found = estimate_position(points, MODEL)
    plain = points.xy.mean(0)
    assert math.hypot(found.x, found.y) < 0.5 * math.hypot(*plain)


def test_views_along_one_ray_leave_the_range_open() -> None:
    """The spread is wide along the ray, narrow across it; a wrong size moves it along the ray."""
    found = estimate_position(seen([(3.0, 0.0)], [(0.0, 0.0), (0.3, 0.0), (0.6, 0.0)]), MODEL)
    xx, xy, yy = found.spread
    assert xx > 1.5 * yy
    assert xy == pytest.approx(0.0, abs=1e-9)
    assert found.slide[0] > 2.0
    assert found.slide[1] == pytest.approx(0.0, abs=1e-9)


_METRES = st.floats(-5.0, 5.0)


@given(
    st.lists(st.tuples(_METRES, _METRES), min_size=1, max_size=4),
    st.lists(st.tuples(_METRES, _METRES), min_size=1, max_size=6),
)
def test_every_point_is_in_one_group_and_every_spread_is_a_covariance(
    things: list[Spot], origins: list[Spot]
) -> None:
    points = seen(things, origins)
    groups = cluster_points(points, np.ones(len(points.xy)), len(points.xy), MODEL)
    assert sorted(i for group in groups for i in group.tolist()) == list(range(len(points.xy)))
    for group in groups:
        xx, xy, yy = estimate_position(points.subset(group), MODEL).spread
        assert min(xx, yy) > 0
        assert xx * yy > xy * xy
