"""Places under keep-apart and join equal a naive constrained DBSCAN after every keyframe."""

import random
from collections.abc import Callable, Hashable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.constrained_places import ConstrainedPlaces
from projections.fold.core_index import CoreIndex, cell_side_um
from projections.fold.corrections import Keyframe
from projections.fold.deltas import MergeRefused, PlaceFormed, PlacesMerged
from projections.fold.pair_groups import ApartPairs, PairGroups, without_contradictions
from projections.fold.place_members import PosedKeyframe
from projections.fold.places import Places
from tests.property.test_places_are_dbscan import EPS_UM, Point
from tests.support.folds import near_matrix
from tests.support.naive_places import NaiveConstrainedPlaces
from tests.support.thorough import rounds

Statements = list[tuple[tuple[int, int], bool]]


def crowd(rng: random.Random) -> list[Point]:
    """Points of a small area in any order: some rooms, and ways between them."""
    step, width = rng.choice([(EPS_UM // 5, 20), (EPS_UM // 2, 10), (EPS_UM, 6), (EPS_UM // 3, 12)])
    height, points = rng.choice([1, 1, 2, 4]), []
    for _ in range(rng.choice([1, 2, 3])):
        x = rng.randrange(width)
        around = range(rng.randrange(1, 8))
        points += [(x + rng.choice([0, 0, 1]), rng.randrange(height)) for _ in around]
    points += [(rng.randrange(width), rng.randrange(height)) for _ in range(rng.randrange(30))]
    if rng.random() < 0.5:
        rng.shuffle(points)
    return [(x * step, y * step, rng.choice([0.0, 0.0, 2.0])) for x, y in points]


def world_of(seed: int) -> tuple[list[Point], Statements]:
    """Points, and pairs of them that are one (true) or kept apart, without contradictions."""
    rng = random.Random(seed)
    points = crowd(rng)
    numbers = range(max(len(points), 2))
    few = rng.sample(numbers, min(rng.choice([2, 4, 8]), len(numbers)))
    wanted = []
    for _ in range(rng.randrange(1, 9)):
        a, b = sorted(rng.sample(few, 2))
        wanted.append(((a, b), rng.random() < 0.25))
    joined, apart = without_contradictions(wanted)
    return points, [(pair, True) for pair in joined] + [(pair, False) for pair in apart]


@st.composite
def worlds(draw: st.DrawFn) -> tuple[list[Point], Statements]:
    """A `world_of` some seed, perhaps cut short."""
    points, statements = world_of(draw(st.integers(0, 2**32)))
    return points[: draw(st.integers(0, 60))], statements


@pytest.mark.parametrize("least", [1, 2, 3, 4, 5])
def test_many_worlds_equal_the_naive_rules(least: int) -> None:
    """Worlds where something is refused are one in two, and small ones take a millisecond."""
    for seed in (315, *range(1000 * least, 1000 * least + rounds(60, 20))):
        check_plain_distance(*world_of(seed), least)


def anchor(point: int) -> Keyframe:
    return Keyframe("r", point)


def constrained(index: CoreIndex, statements: Statements) -> ConstrainedPlaces:
    joined = [(anchor(a), anchor(b)) for (a, b), is_same in statements if is_same]
    apart = [(anchor(a), anchor(b)) for (a, b), is_same in statements if not is_same]
    return ConstrainedPlaces(index, PairGroups(joined, ApartPairs.of(apart)))


def naive_of(
    statements: Statements, least: int, cell_of: Callable[[int], Hashable]
) -> NaiveConstrainedPlaces:
    joined = [pair for pair, is_same in statements if is_same]
    apart = [pair for pair, is_same in statements if not is_same]
    return NaiveConstrainedPlaces(least, cell_of, joined, apart)


def cell(point: Point) -> tuple[int, int]:
    side = cell_side_um(EPS_UM)
    return point[0] // side, point[1] // side


def _within_eps(a: Point, b: Point) -> bool:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 <= EPS_UM**2


def check_every_prefix(
    new_index: Callable[[], CoreIndex],
    points: list[Point],
    statements: Statements,
    matrix: np.ndarray,
    least: int,
    cell_of: Callable[[int], Hashable],
) -> None:
    naive = naive_of(statements, least, cell_of)
    places = constrained(new_index(), statements)
    refused: set[tuple[int, int]] = set()
    founders: list[int] = []
    for n, (x, y, _) in enumerate(points):
        places.add_anchor(n, anchor(n))
        deltas = places.fold(PosedKeyframe(n, n, 0, "r", x, y))
        naive.add(matrix[: n + 1, : n + 1])
        ours = [places.label(i) for i in range(n + 1)]
        assert ours == naive.labels
        members = [label for label in ours if label is not None]
        assert all(places.member_counts[p] == members.count(p) for p in set(members))
        founders += [d.founder for d in deltas if type(d) is PlaceFormed]
        assert founders == naive.founders
        for delta in deltas:
            if type(delta) is MergeRefused:
                assert (delta.a, delta.b) not in refused
                refused.add((delta.a, delta.b))
                after = [places.survivors.find(place) for place in (delta.a, delta.b)]
                assert [places.label(k) for k in delta.apart] == after
                assert frozenset(delta.apart) in naive.enemies
        assert refused == naive.refused
        restored = constrained(new_index(), statements)
        restored.load(places.dump())
        places = restored if n % 3 == 0 else places


@given(world=worlds(), least=st.integers(1, 6))
def test_plain_distance_equals_the_naive_rules(
    world: tuple[list[Point], Statements], least: int
) -> None:
    check_plain_distance(*world, least)


def check_plain_distance(points: list[Point], statements: Statements, least: int) -> None:
    check_every_prefix(
        lambda: CoreIndex(EPS_UM, least),
        points,
        statements,
        near_matrix(len(points), lambda i, j: _within_eps(points[i], points[j])),
        least,
        lambda i: cell(points[i]),
    )


@given(world=worlds(), least=st.integers(1, 6))
def test_pairs_that_refuse_and_join_nothing_change_no_delta(
    world: tuple[list[Point], Statements], least: int
) -> None:
    points, statements = world
    plain = Places(CoreIndex(EPS_UM, least))
    ours = constrained(CoreIndex(EPS_UM, least), statements)
    matrix = near_matrix(len(points), lambda i, j: _within_eps(points[i], points[j]))
    naive = naive_of(statements, least, lambda i: cell(points[i]))
    for n, point in enumerate(points):
        ours.add_anchor(n, anchor(n))
        posed = PosedKeyframe(n, n, 0, "r", *point[:2])
        expected, deltas = plain.fold(posed), ours.fold(posed)
        naive.add(matrix[: n + 1, : n + 1])
        if naive.had_effect or any(naive.conflict(inside, inside) for inside in naive.inside):
            return
        assert deltas == expected


@given(world=worlds(), least=st.integers(1, 6))
def test_a_link_is_of_core_points_of_the_two_sides(
    world: tuple[list[Point], Statements], least: int
) -> None:
    points, statements = world
    places = constrained(CoreIndex(EPS_UM, least), statements)
    for n, point in enumerate(points):
        places.add_anchor(n, anchor(n))
        labels = [places.label(i) for i in range(n)]
        deltas = places.fold(PosedKeyframe(n, n, 0, "r", *point[:2]))
        for merge in deltas:
            if type(merge) is PlacesMerged and not merge.joined:
                for absorbed, link in zip(merge.absorbed, merge.links, strict=True):
                    assert places.core_index.is_core(link.core)
                    assert places.core_index.are_neighbours(link.core, link.neighbour)
                    assert labels[link.neighbour] == absorbed
            elif type(merge) is PlacesMerged:
                (link,), (absorbed,) = merge.links, merge.joined
                assert {places.label(link.core), places.label(link.neighbour)} == {
                    places.label(places.keyframes.index(link.core))
                }
                assert merge.absorbed == (absorbed,)
