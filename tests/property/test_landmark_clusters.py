"""Landmarks from points along rays: clusters, positions and their covariances."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.evidence import EvidenceConstants
from projections.relocalize import Camera
from projections.relocalize.camera import views
from projections.relocalize.triangulation import (
    Points,
    cluster_points,
    estimate_position,
    points_of,
    triangulate,
)

Spot = tuple[float, float]
SURE = EvidenceConstants(bearing_rad=0.02, pose_m=0.06)
"""A robot whose bearings and poses are good."""
SIZE_ERROR = 0.05


def seen(things: Sequence[Spot], origins: Sequence[Spot], stretch: float = 1.0) -> Points:
    """Every thing from every origin, the range wrong by the factor ``stretch``."""
    pairs = [(origin, thing) for thing in things for origin in origins]
    origin = np.array([pair[0] for pair in pairs])
    ray = stretch * (np.array([pair[1] for pair in pairs]) - origin)
    return points_of(origin, ray, np.zeros(len(pairs), dtype=bool), SIZE_ERROR, SURE)


def test_neighbours_half_a_metre_apart_are_two_things() -> None:
    """A circle wide enough for the errors along the rays would merge them."""
    origins = [(0.0, 0.0), (0.2, 0.0), (0.4, 0.0)]
    points = seen([(-0.25, 3.0), (0.35, 3.0)], origins)
    groups = cluster_points(points, np.ones(6), 9)
    assert sorted(sorted(group.tolist()) for group in groups) == [[0, 1, 2], [3, 4, 5]]


def test_crossing_bearings_give_the_position_though_the_range_is_wrong() -> None:
    """Two views square to each other, ranges a tenth too long: the crossing is nearer."""
    points = seen([(0.0, 0.0)], [(3.0, 0.0), (0.0, 3.0)], stretch=1.1)
    found = estimate_position(points)
    plain = points.xy.mean(0)
    assert math.hypot(found.x, found.y) < 0.5 * math.hypot(*plain)


def test_views_along_one_ray_leave_the_range_open() -> None:
    """The spread is wide along the ray, narrow across it; a wrong size moves it along the ray."""
    found = estimate_position(seen([(3.0, 0.0)], [(0.0, 0.0), (0.3, 0.0), (0.6, 0.0)]))
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
    groups = cluster_points(points, np.ones(len(points.xy)), len(points.xy))
    assert sorted(i for group in groups for i in group.tolist()) == list(range(len(points.xy)))
    for group in groups:
        xx, xy, yy = estimate_position(points.subset(group)).spread
        assert min(xx, yy) > 0
        assert xx * yy > xy * xy


def test_more_views_from_one_spot_do_not_make_a_position_sure() -> None:
    """Looking around on one spot shares one error; from another spot a view adds information."""
    few = seen([(3.0, 0.0)], [(0.0, 0.0), (0.01, 0.0)])
    many = seen([(3.0, 0.0)], [(0.01 * k, 0.0) for k in range(20)])
    elsewhere = seen([(3.0, 0.0)], [(0.0, 0.0), (3.0, 3.0)])
    variances = [estimate_position(points).spread[0] for points in (few, many, elsewhere)]
    assert variances[1] == pytest.approx(variances[0], rel=0.1)
    assert variances[2] < 0.5 * variances[0]


def test_views_that_cross_find_the_position_whatever_the_usual_distance() -> None:
    """A box of one size seen from four sides: its distance follows from the bearings."""
    boxes, poses = [], []
    for quarter in range(8):
        angle, far = quarter * math.pi / 4, 2.0 + 0.25 * (quarter % 3)
        half = 0.5 * 0.8 * Camera().focal_px / far
        boxes.append((320.0 - half, 200.0 - half, 320.0 + half, 200.0 + half))
        poses.append((far * math.cos(angle), far * math.sin(angle), angle + math.pi))
    for usual in (1.0, 2.0, 4.0):
        evidence = EvidenceConstants(range_m=usual)
        found = triangulate(np.array(poses), views(Camera(), boxes), np.ones(8), evidence, 5)
        assert [len(each.members) for each in found] == [8]
        assert math.hypot(found[0].x, found[0].y) < 0.1
