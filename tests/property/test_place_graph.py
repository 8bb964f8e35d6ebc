"""Hops and paths between places, against every way there is."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.map.naming import NoSuchThing
from projections.postgres.queries.graph_reads import PlaceGraph, PlaceNode

SIZE = 6
EDGES = st.dictionaries(
    st.tuples(st.integers(0, SIZE - 1), st.integers(0, SIZE - 1)).filter(lambda e: e[0] < e[1]),
    st.integers(1, 3),
)
ENDS = st.integers(0, SIZE - 1)


def graph(edges: dict[tuple[int, int], int]) -> PlaceGraph:
    nodes = [PlaceNode(i, f"p{i}", float(i), 0.0, 3) for i in range(SIZE)]
    return PlaceGraph(nodes, [(a, b, n) for (a, b), n in edges.items()])


def all_ways(edges: dict[tuple[int, int], int], a: int, b: int) -> list[list[int]]:
    """Every simple way, by trying all orders of all places."""
    others = [p for p in range(SIZE) if p not in (a, b)]
    if a == b:
        return [[a]]
    ways = []
    for count in range(len(others) + 1):
        for middle in itertools.permutations(others, count):
            way = [a, *middle, b]
            if all(tuple(sorted(step)) in edges for step in itertools.pairwise(way)):
                ways.append(way)
    return ways


def weakest(edges: dict[tuple[int, int], int], way: list[int]) -> int:
    return min((edges[min(s), max(s)] for s in itertools.pairwise(way)), default=1 << 62)


@given(EDGES, ENDS, ENDS)
def test_the_path_is_the_best_of_all_ways(
    edges: dict[tuple[int, int], int], a: int, b: int
) -> None:
    ways = all_ways(edges, a, b)
    best = min(ways, key=lambda w: (len(w), -weakest(edges, w), w)) if ways else None
    found = graph(edges).path(a, b)
    if best is None:
        assert found is None
    else:
        assert found is not None
        assert (len(found), weakest(edges, found)) == (len(best), weakest(edges, best))
        assert all(tuple(sorted(step)) in edges for step in itertools.pairwise(found))


@given(EDGES, ENDS, st.integers(0, SIZE))
def test_hops_are_the_length_of_the_shortest_way(
    edges: dict[tuple[int, int], int], start: int, most: int
) -> None:
    expected = {}
    for place in range(SIZE):
        ways = all_ways(edges, start, place)
        if ways and min(map(len, ways)) - 1 <= most:
            expected[place] = min(map(len, ways)) - 1
    assert graph(edges).hops_from(start, most) == expected


def test_a_place_that_is_not_there_is_named() -> None:
    with pytest.raises(NoSuchThing, match="'nowhere'"):
        graph({}).find("nowhere")
