"""After every keyframe the places equal batch DBSCAN and a naive implementation of the rules."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.core_index import CoreIndex
from projections.fold.deltas import PlacesMerged
from projections.fold.place_members import PosedKeyframe
from projections.fold.places import Places
from tests.support.folds import NaivePlaces, batch_dbscan, near_matrix

Point = tuple[int, int, float]
EPS_UM = 1_500_000


def _lattice(step_um: int, reach: int) -> st.SearchStrategy[Point]:
    """Points on a lattice, so that many are at exactly the same distance, or at the same spot."""
    index = st.integers(-reach, reach)
    return st.builds(lambda i, j: (i * step_um, j * step_um, 0.0), index, index)


LISTS = st.one_of(
    st.lists(_lattice(EPS_UM, 3), max_size=25),  # neighbours exactly at ε
    st.lists(_lattice(EPS_UM // 2, 5), max_size=40),
    st.lists(_lattice(EPS_UM // 5, 12), max_size=40),
    st.lists(st.builds(lambda i: (i * EPS_UM, 0, 0.0), st.integers(0, 25)), max_size=25),
    st.lists(
        st.builds(lambda x, y: (x, y, 0.0), *[st.integers(-5_000_000, 5_000_000)] * 2), max_size=40
    ),
)


@st.composite
def walks(draw: st.DrawFn) -> list[Point]:
    """A robot's way: steps of up to a metre, with turns."""
    steps = draw(st.lists(st.tuples(st.integers(0, 1_000_000), st.integers(0, 11)), max_size=45))
    x = y = 0
    points = []
    for length, heading in steps:
        yaw = heading * math.pi / 6
        x += round(length * math.cos(yaw))
        y += round(length * math.sin(yaw))
        points.append((x, y, yaw))
    return points


POINTS = st.one_of(LISTS, walks())


def check_every_prefix(places: Places, points: list[Point], matrix: np.ndarray, least: int) -> None:
    naive = NaivePlaces(least)
    for n, (x, y, _) in enumerate(points, start=1):
        places.fold(PosedKeyframe(n - 1, n - 1, 0, "r", x, y))
        are_near = matrix[:n, :n]
        labels, cores = batch_dbscan(are_near, least)
        ours = [places.label(i) for i in range(n)]
        assert {i for i in range(n) if places.core_index.is_core(i)} == cores
        assert {i for i in range(n) if ours[i] is None} == set(np.flatnonzero(labels == -1))
        assert len({(ours[i], labels[i]) for i in cores}) == len({ours[i] for i in cores})
        assert len({ours[i] for i in cores}) == len({labels[i] for i in cores})
        naive.add(are_near)
        assert ours == naive.labels
        members = [label for label in ours if label is not None]
        assert all(places.member_counts[label] == members.count(label) for label in set(members))


@given(points=POINTS, least=st.integers(1, 9))
def test_plain_distance_equals_batch_dbscan(points: list[Point], least: int) -> None:
    def is_near(i: int, j: int) -> bool:
        (ax, ay, _), (bx, by, _) = points[i], points[j]
        return (ax - bx) ** 2 + (ay - by) ** 2 <= EPS_UM**2

    places = Places(CoreIndex(EPS_UM, least))
    check_every_prefix(places, points, near_matrix(len(points), is_near), least)


@given(points=POINTS, least=st.integers(1, 5), eps=st.integers(0, 4))
def test_smallest_epsilons_equal_batch_dbscan(points: list[Point], least: int, eps: int) -> None:
    small = [(x // 500_000, y // 500_000, yaw) for x, y, yaw in points]

    def is_near(i: int, j: int) -> bool:
        return (small[i][0] - small[j][0]) ** 2 + (small[i][1] - small[j][1]) ** 2 <= eps**2

    places = Places(CoreIndex(eps, least))
    check_every_prefix(places, small, near_matrix(len(small), is_near), least)


@given(points=POINTS, least=st.integers(1, 6))
def test_a_link_is_of_a_fresh_core_point_and_an_older_one_of_the_absorbed_place(
    points: list[Point], least: int
) -> None:
    places = Places(CoreIndex(EPS_UM, least))
    for n, (x, y, _) in enumerate(points):
        cores = {i for i in range(n) if places.core_index.is_core(i)}
        labels = [places.label(i) for i in range(n)]
        for merge in places.fold(PosedKeyframe(n, n, 0, "r", x, y)):
            if type(merge) is not PlacesMerged:
                continue
            for absorbed, link in zip(merge.absorbed, merge.links, strict=True):
                assert link.core not in cores
                assert places.core_index.is_core(link.core)
                assert link.neighbour in cores
                assert labels[link.neighbour] == absorbed
                assert places.core_index.are_neighbours(link.core, link.neighbour)
