"""Landmarks from points along rays: clusters, positions and their covariances."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import CameraConstants
from projections.localize.relocalize.camera import Cameras, box_rows, camera_values, views
from projections.localize.relocalize.triangulation import (
    Points,
    cluster_points,
    estimate_positions,
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
    origin = np.array([pair[0] for pair in pairs]).T
    ray = stretch * (np.array([pair[1] for pair in pairs]).T - origin)
    size = np.full(len(pairs), SIZE_ERROR)
    return points_of(origin, ray, np.zeros(len(pairs), dtype=bool), size, SURE)


class Position(NamedTuple):
    """A landmark's."""

    x: float
    y: float
    spread: tuple[float, float, float]
    slide: tuple[float, float]


def estimate_position(points: Points) -> Position:
    """Of one thing that all points show."""
    found = estimate_positions(points, np.zeros(1, dtype=np.intp))
    (x,), (y,) = found.xy.tolist()
    (xx,), (xy,), (yy,) = found.spread.tolist()
    (sx,), (sy,) = found.slide.tolist()
    return Position(x, y, (xx, xy, yy), (sx, sy))


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
    plain = points.xy.mean(1)
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
    groups = cluster_points(points, np.ones(points.count), points.count)
    assert sorted(i for group in groups for i in group.tolist()) == list(range(points.count))
    sizes = [len(group) for group in groups]
    together = estimate_positions(
        points.subset(np.concatenate(groups)), np.cumsum(sizes) - np.array(sizes)
    )
    for number, group in enumerate(groups):
        found = estimate_position(points.subset(group))
        xx, xy, yy = found.spread
        assert min(xx, yy) > 0
        assert xx * yy > xy * xy
        assert together.xy[:, number].tolist() == pytest.approx([found.x, found.y])
        assert together.spread[:, number].tolist() == pytest.approx(found.spread)
        assert together.slide[:, number].tolist() == pytest.approx(found.slide)


def slow_clusters(points: Points, weight: list[float], most: int) -> list[list[int]]:
    """Densest first, with every support summed from scratch for every cluster."""
    count = points.count
    (x, y), (ux, uy), (along, across) = points.xy, points.direction, points.sigma

    def chi(i: int, at: tuple[float, float]) -> float:
        dx, dy = at[0] - x[i], at[1] - y[i]
        one, two = (dx * ux[i] + dy * uy[i]) / along[i], (dy * ux[i] - dx * uy[i]) / across[i]
        return float(one * one + two * two)

    near = [[math.exp(-0.5 * chi(j, (x[i], y[i]))) for j in range(count)] for i in range(count)]
    free, found = set(range(count)), []
    while free and len(found) < most:
        support = {i: sum(near[i][j] * weight[j] for j in free) for i in free}
        centre = max(sorted(free), key=lambda i: support[i])
        part = np.array([near[centre][j] * (j in free) for j in range(count)])
        xx, xy, yy, mx, my = (points.moments[:5] * part).sum(1).tolist()
        det = xx * yy - xy * xy
        at = ((yy * mx - xy * my) / det, (xx * my - xy * mx) / det)
        members = {i for i in free if chi(i, at) < 5.0} | {centre}
        found.append(sorted(members))
        free -= members
    return found


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
@settings(deadline=None)
def test_clusters_are_those_of_supports_summed_from_scratch(seed: int, most: int) -> None:
    """Also where some of the points are so far away that they are of no account to each other."""
    rng = np.random.default_rng(seed)
    things = [(float(x), float(y)) for x, y in rng.uniform(-3, 3, (3, 2))]
    things += [(float(x) + 300.0, float(y)) for x, y in rng.uniform(-3, 3, (3, 2))]
    origins = [(float(x), float(y)) for x, y in rng.uniform(-3, 3, (3, 2))]
    here, there = seen(things[:3], origins), seen(things[3:], [(x + 300.0, y) for x, y in origins])
    points = Points(np.concatenate((here.rows, there.rows), axis=1))
    weight = rng.uniform(0.1, 1.0, points.count)
    found = [group.tolist() for group in cluster_points(points, weight, most)]
    assert found == slow_clusters(points, weight.tolist(), most)


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
    cameras = Cameras.of([camera_values(CameraConstants())])
    focal = float(cameras.focal_px[0])
    for quarter in range(8):
        angle, far = quarter * math.pi / 4, 2.0 + 0.25 * (quarter % 3)
        half = 0.5 * 0.8 * focal / far
        boxes.append((320.0 - half, 200.0 - half, 320.0 + half, 200.0 + half))
        poses.append((far * math.cos(angle), far * math.sin(angle), angle + math.pi))
    for usual in (1.0, 2.0, 4.0):
        evidence = EvidenceConstants(range_m=usual)
        # of two crops: the other's things lie 50 m away
        beside = [*poses, *((x + 50.0, y, angle) for x, y, angle in poses)]
        rows = box_rows([*boxes, *boxes])
        crops = triangulate(
            np.array(beside),
            views(cameras, rows),
            np.ones(16),
            np.array([0, 8]),
            [5, 5],
            evidence,
        )
        for number, found in enumerate(crops):
            assert [each.members.tolist() for each in found] == [[8 * number + i for i in range(8)]]
            assert math.hypot(found[0].x - 50.0 * number, found[0].y) < 0.1
