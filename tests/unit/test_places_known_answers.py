"""Places of small worlds whose answers are known."""

import random

import pytest

from projections.fold.core_index import CoreIndex
from projections.fold.deltas import (
    KeyframePlaced,
    PlaceChanged,
    PlaceFormed,
    PlaceLink,
    PlacesLinked,
    PlacesMerged,
)
from projections.fold.place_members import PosedKeyframe
from projections.fold.places import Places
from tests.support.envelopes import envelope
from tests.support.folds import fold


def test_the_second_end_makes_the_middle_core() -> None:
    """Ends 2.4 m apart with the middle between them: only the middle has three neighbours."""
    folded = fold([envelope(0, 0.0, 0.0), envelope(1, 1.2, 0.0), envelope(2, 2.4, 0.0)])
    assert folded.deltas[2][1:] == [
        PlaceFormed(2, 0, "run-a_p0", founder=1),
        KeyframePlaced(2, 0, 0),
        KeyframePlaced(2, 1, 0),
        KeyframePlaced(2, 2, 0),
        PlaceChanged(2, 0, 3, 3_600_000, 0),
    ]
    assert folded.view.places[0].centroid_x == 1.2


def test_epsilon_is_inclusive_to_the_micrometre() -> None:
    at_eps = fold([envelope(0, 0.0, 0.0), envelope(1, 1.5, 0.0)], min_samples=2)
    beyond = fold([envelope(0, 0.0, 0.0), envelope(1, 1.500001, 0.0)], min_samples=2)
    assert len(at_eps.view.places) == 1
    assert len(beyond.view.places) == 0


def _three_at(first_id: int, x: float) -> list[dict]:
    return [envelope(first_id + i, x, 0.1 * i) for i in range(3)]


def test_a_merge_names_the_bridge_and_the_pair_that_reached_over() -> None:
    """Two groups 2.6 m apart; a keyframe in between is core and joins them."""
    folded = fold([*_three_at(0, 0.0), *_three_at(3, 2.6), envelope(6, 1.3, 0.0)])
    (merge,) = folded.all(PlacesMerged)
    assert merge == PlacesMerged(
        6,
        survivor=0,
        absorbed=(1,),
        bridge=6,
        links=(PlaceLink(core=6, neighbour=3, distance_um=1_300_000),),
        survivor_count=3,
        absorbed_counts=(3,),
    )
    assert folded.view.places[0].keyframe_count == 7
    assert list(folded.view.places) == [0]


def test_a_link_reaches_a_core_point_that_the_absorbed_place_had_before() -> None:
    """The newcomer, 6, shares a cell with 1, an old core point; and it makes 3 core, which is near
    6 but not near 1. The link is between 6 and 1: neither 3 nor 6 was of the absorbed place."""
    spots = [(0, 0.6), (1.8, 0.3), (-1.5, 0.6), (0.3, 0.6), (2.4, 0.9), (1.8, -0.6), (1.5, 0.9)]
    folded = fold(envelope(i, x, y) for i, (x, y) in enumerate(spots))
    (merge,) = folded.all(PlacesMerged)
    assert (merge.survivor, merge.absorbed, merge.bridge) == (0, (1,), 6)
    assert merge.links == (PlaceLink(core=6, neighbour=1, distance_um=670_820),)


def test_a_newcomer_that_is_not_core_can_still_merge_two_places() -> None:
    """It makes keyframes 10 and 11 core, which each reach one point of either group of five."""
    left = [(0.0, 0.0)] + [(-0.3, 0.0)] * 4
    right = [(2.6, 0.0)] + [(2.9, 0.0)] * 4
    between = [(1.3, 0.0), (1.3, -0.7)]
    spots = [*left, *right, *between, (1.3, -1.4)]
    folded = fold((envelope(i, x, y) for i, (x, y) in enumerate(spots)), min_samples=5)
    assert len(folded.all(PlaceFormed)) == 2
    (merge,) = folded.all(PlacesMerged)
    assert (merge.survivor, merge.absorbed, merge.bridge) == (0, (1,), 12)
    assert merge.links == (PlaceLink(core=10, neighbour=5, distance_um=1_300_000),)
    assert not folded.map.places.core_index.is_core(12)
    assert folded.view.places[0].keyframe_count == 13


def test_ten_places_merge_into_the_one_founded_first_not_into_the_first_by_text() -> None:
    """p2 … p11 in one run stand in a circle around a hub; p10 sorts before p2 as text."""
    documents, keyframe_id = [], 0
    for x in (100.0, 200.0):  # p0 and p1 stay out of it
        documents += _three_at(keyframe_id, x)
        keyframe_id += 3
    spokes = [(1.2 * i, 1.2 * j) for i in (-2, 0, 2) for j in (-2, 0, 2) if (i, j) != (0, 0)]
    spokes += [(6.0, 0.0), (-6.0, 0.0)]
    for x, y in spokes:
        documents += [envelope(keyframe_id + n, x, y) for n in range(3)]
        keyframe_id += 3
    bridges = [(3.6, 0.0), (4.8, 0.0), (-3.6, 0.0), (-4.8, 0.0)]
    bridges += [(1.2, y) for y in (-2.4, 0.0, 2.4)] + [(-1.2, y) for y in (-2.4, 0.0, 2.4)]
    bridges += [(0.0, 1.2), (0.0, -1.2), (0.0, 0.0)]
    for n, (x, y) in enumerate(bridges):
        documents.append(envelope(keyframe_id + n, x, y))
    folded = fold(documents, eps_m=1.2)
    assert len(folded.all(PlaceFormed)) == 12
    assert [p.place_id for p in folded.view.places.values()] == ["run-a_p0", "run-a_p1", "run-a_p2"]
    assert sum(len(m.absorbed) for m in folded.all(PlacesMerged)) == 9
    assert {m.survivor for m in folded.all(PlacesMerged)} >= {2}


def test_one_keyframe_merges_three_at_once() -> None:
    """Three groups 1.5 m from the origin, 120 degrees apart, and then the origin."""
    corners = [(1.5, 0.0), (-0.75, 1.299), (-0.75, -1.299)]
    documents = [envelope(i, *corners[i // 3]) for i in range(9)]
    folded = fold([*documents, envelope(9, 0.0, 0.0)])
    (merge,) = folded.all(PlacesMerged)
    assert (merge.survivor, merge.absorbed) == (0, (1, 2))
    assert merge.absorbed_counts == (3, 3)
    assert [(link.core, link.neighbour) for link in merge.links] == [(9, 3), (9, 6)]


def test_a_border_point_stays_with_the_place_it_joined_first() -> None:
    """Keyframe 3 lies between two places, core in neither; the right one comes later."""
    left, right = [-0.1, 0.0, 0.1, 0.2], [2.5, 2.6, 2.7, 2.8]
    documents = [envelope(i, x, 0.0) for i, x in enumerate([*left, 1.35, *right])]
    view = fold(documents, eps_m=1.2, min_samples=4).view
    assert [p.place_id for p in view.places.values()] == ["run-a_p0", "run-a_p1"]
    assert view.keyframes[4].place == 0
    assert not view.adjacency.get((1, 0))
    assert view.adjacency == {(0, 1): 1}


@pytest.mark.parametrize("turn", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_newcomer_between_two_places_joins_the_one_founded_first(turn: tuple[int, int]) -> None:
    """Wherever it lies: it reaches one core point of either, and three neighbours are too few."""
    first, second = [1.2, 1.6, 1.7, 1.8], [-1.2, -1.6, -1.7, -1.8]
    spots = [(x * turn[0], x * turn[1]) for x in [*first, *second, 0.0]]
    view = fold((envelope(i, x, y) for i, (x, y) in enumerate(spots)), min_samples=4).view
    assert len(view.places) == 2
    assert view.keyframes[8].place == 0


def test_a_place_is_named_by_the_run_of_its_founder() -> None:
    """Run B's keyframe makes run A's core: A's keyframe is the place's first core point."""
    documents = [
        envelope(0, 0.0, 0.0, run_id="a"),
        envelope(0, 1.4, 0.0, run_id="b"),
        envelope(1, -1.4, 0.0, run_id="b"),
    ]
    (found,) = fold(documents).all(PlaceFormed)
    assert found.place_id == "a_p0"


def test_a_second_run_with_the_same_keyframe_numbers_is_folded_whole() -> None:
    documents = [
        envelope(i, i * 0.5, y, run_id=run) for run, y in (("a", 0.0), ("b", 9.0)) for i in range(5)
    ]
    view = fold(documents).view
    assert view.counts()["keyframes"] == 10
    assert view.counts()["duplicates"] == 0
    assert [p.place_id for p in view.places.values()] == ["a_p0", "b_p0"]


def test_absorbing_a_place_takes_its_edges_along() -> None:
    """Three places in a row by one run; then the first two merge."""
    row = [*_three_at(0, 0.0), *_three_at(3, 2.6), *_three_at(6, 5.6)]
    folded = fold([*row, envelope(100, 1.3, 0.1)])
    assert [d for d in folded.deltas[-1] if type(d) is PlacesLinked] == [
        PlacesLinked(9, 0, 1, 0),
        PlacesLinked(9, 0, 2, 2),
        PlacesLinked(9, 1, 2, 0),
    ]
    # 2 → 3 is inside now; 5 → 6 goes over, and so does 8 → 100, back to the bridge.
    assert folded.view.adjacency == {(0, 2): 2}


def test_a_year_in_one_room_leaves_nothing_to_count() -> None:
    """No counts, no points that are not core, no unlinked cells."""
    places, rng = Places(CoreIndex(1_500_000, 3)), random.Random(1)
    for n in range(20_000):
        places.fold(PosedKeyframe(n, n, 0, "r", rng.randrange(4_000_000), rng.randrange(3_000_000)))
    state = places.dump()
    assert state["crowd.loose"].tolist() == []
    assert state["crowd.sparse_cores"].tolist() == []
    assert all(not cell.unlinked for cell in places.core_index._cells.values())


@pytest.mark.slow
@pytest.mark.seconds
def test_the_envelopes_of_two_rooms_with_a_wall_between_stay_short() -> None:
    """Cells 1.6 m apart stay unlinked forever, so every keyframe queries their reach indexes."""
    core_index, rng = CoreIndex(1_500_000, 3), random.Random(2)
    places = Places(core_index)
    for n in range(20_000):
        x = rng.randrange(500_000) + (n % 2) * 2_100_000
        places.fold(PosedKeyframe(n, n, 0, "r", x, rng.randrange(3_000_000)))
    assert {places.label(n) for n in range(20_000)} == {0, 1}
    sides = [s for cell in core_index._cells.values() for s in cell.sides or () if s is not None]
    assert sides
    assert max(len(side._centres) for side in sides) < 60


def test_noise_is_labelled_none() -> None:
    places = Places(CoreIndex(1_500_000, 3))
    assert places.fold(PosedKeyframe(0, 0, 0, "r", 0, 0)) == []
    assert places.label(0) is None
