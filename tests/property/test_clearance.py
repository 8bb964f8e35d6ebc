"""Clearance and regions of small grids, against versions that only have to be right."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold.map_regions import (
    MIN_WIDTH_M,
    NOWHERE,
    PASSAGE,
    USUAL_M2,
    Labels,
    Walls,
    clearance,
    clearance_cap,
    regions,
)
from tests.support.thorough import examples

grids = st.builds(
    lambda rows, columns, share, seed: np.random.default_rng(seed).random((rows, columns)) < share,
    st.integers(1, 14),
    st.integers(1, 14),
    st.sampled_from([0.0, 0.05, 0.2, 0.5, 1.0]),
    st.integers(0, 2**32 - 1),
)


@settings(max_examples=examples(500))
@given(grids, st.integers(2, 20))
def test_clearance_is_the_distance_to_the_nearest_wall(walls: Walls, cap: int) -> None:
    at = np.argwhere(walls)
    found = clearance(walls, cap)
    for row, column in np.ndindex(walls.shape):
        squares = [(row - r) ** 2 + (column - c) ** 2 for r, c in at]
        assert found[row, column] == min([cap * cap, *squares])


def _regions(walls: Walls, cell_m: float) -> Labels:
    return regions(clearance(walls, clearance_cap(cell_m)), cell_m)


def _slow_regions(walls: Walls, cell_m: float) -> Labels:
    """The rules of the module, one set of cells for each region."""
    wide = clearance(walls, max(2, math.ceil(3.0 / cell_m)))
    rows, columns = walls.shape
    cells = [(r, c) for r in range(rows) for c in range(columns) if not walls[r, c]]
    cells.sort(key=lambda rc: (-wide[rc], rc))
    groups: list[dict[str, object]] = []
    member: dict[tuple[int, int], set[tuple[int, int]]] = {}
    width: dict[int, int] = {}
    usual: dict[int, int] = {}
    born: dict[int, int] = {}
    enough = math.ceil(USUAL_M2 / cell_m**2)
    for row, column in cells:
        own = int(wide[row, column])
        steps = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
        beside = [(row + d, column + r) for d, r in steps if (row + d, column + r) in member]
        if not beside:
            new = {(row, column)}
            member[row, column] = new
            width[id(new)], born[id(new)] = own, len(groups)
            usual[id(new)] = own if enough == 1 else 0
            groups.append({"keep": new})  # so that no id is used twice
            continue
        nearest = max(beside, key=lambda rc: (wide[rc], -beside.index(rc)))
        touched = {id(member[rc]): member[rc] for rc in beside}
        joined = member[nearest]
        joined.add((row, column))
        member[row, column] = joined
        if len(joined) == enough:
            usual[id(joined)] = own
        ordered = sorted(touched.values(), key=lambda g: (-width[id(g)], born[id(g)]))
        apart = ordered[:1]
        for other in ordered[1:]:
            for main in apart:
                w, of_both = width[id(other)], max(usual[id(main)], usual[id(other)])
                needed = PASSAGE[0] / PASSAGE[1] * math.sqrt(min(w, of_both))
                is_wide = math.sqrt(own) >= needed - 1e-12
                if is_wide or w < math.floor((MIN_WIDTH_M / cell_m) ** 2):
                    main |= other
                    usual[id(main)] = of_both or (own if len(main) >= enough else 0)
                    for rc in other:
                        member[rc] = main
                    break
            else:
                apart.append(other)
    labels = np.full(walls.shape, NOWHERE, np.int32)
    numbers: dict[int, int] = {}
    for row, column in sorted(member):
        labels[row, column] = numbers.setdefault(id(member[row, column]), len(numbers))
    return labels


@settings(max_examples=examples(500))
@given(grids, st.sampled_from([0.05, 0.1, 0.3]))
def test_regions_are_those_of_the_rules(walls: Walls, cell_m: float) -> None:
    assert np.array_equal(_regions(walls, cell_m), _slow_regions(walls, cell_m))


@settings(max_examples=examples(500))
@given(grids)
def test_every_cell_that_is_no_wall_has_a_region(walls: Walls) -> None:
    assert np.array_equal(_regions(walls, 0.1) == NOWHERE, walls)


def _plan(text: str) -> Walls:
    return np.array([[c == "#" for c in line.strip()] for line in text.split()])


def _room(wide: int, high: int) -> Walls:
    room = np.ones((high + 2, wide + 2), bool)
    room[1:-1, 1:-1] = False
    return room


@pytest.mark.parametrize("door", [6, 8, 10, 12])
def test_a_door_parts_two_rooms(door: int) -> None:
    walls = np.concatenate([_room(30, 30), _room(40, 30)[:, 1:]], axis=1)
    walls[12 : 12 + door, 31] = False
    found = _regions(walls, 0.1)
    assert set(found[~walls].tolist()) == {0, 1}
    assert len(set(found[1:-1, 1:28].ravel().tolist())) == 1
    assert found[15, 5] != found[15, 60]


def test_a_wide_opening_parts_nothing() -> None:
    walls = np.concatenate([_room(30, 30), _room(40, 30)[:, 1:]], axis=1)
    walls[2:30, 31] = False
    assert set(_regions(walls, 0.1)[~walls].tolist()) == {0}


def test_a_corridor_is_one_region_beside_its_rooms() -> None:
    walls = np.ones((52, 100), bool)
    walls[1:31, 1:33] = walls[1:31, 34:66] = walls[1:31, 67:99] = False  # rooms of 3.2 m by 3 m
    walls[32:50, 1:99] = False  # a corridor of 1.8 m
    for door in (12, 45, 80):
        walls[31, door : door + 9] = False
    found = _regions(walls, 0.1)
    corridor = set(found[41, 1:99].tolist())
    rooms = {int(found[15, column]) for column in (15, 50, 80)}
    assert len(corridor) == 1
    assert len(rooms) == 3
    assert not rooms & corridor


def test_a_corridor_is_one_region_though_wider_at_doors_and_where_another_crosses() -> None:
    walls = np.ones((90, 170), bool)
    walls[1:31, 1:169] = walls[53:83, 1:169] = False  # what is behind the doors
    for door in (20, 60, 100, 140):
        walls[31, door : door + 12] = walls[52, door : door + 12] = False  # facing doors
    walls[1:83, 110:128] = True
    walls[1:83, 111:127] = False  # a corridor of 1.6 m
    walls[32:52, 1:169] = False  # one of 2 m across
    found = _regions(walls, 0.1)
    corridor = set(found[41, 1:169].tolist())
    assert len(corridor) == 1
    assert set(found[2:82, 119].tolist()) == corridor
    assert not corridor & set(found[15, 1:105].tolist())


def test_what_is_too_narrow_for_a_room_is_part_of_what_it_opens_to() -> None:
    walls = _room(30, 30)
    niche = np.ones((32, 8), bool)
    niche[10:15, 0:6] = False  # half a metre wide
    both = np.concatenate([walls[:, :-1], niche], axis=1)
    assert set(_regions(both, 0.1)[~both].tolist()) == {0}


def test_a_map_without_walls_is_one_region_and_one_of_walls_is_none() -> None:
    assert set(_regions(np.zeros((20, 30), bool), 0.1).ravel().tolist()) == {0}
    assert set(_regions(np.ones((20, 30), bool), 0.1).ravel().tolist()) == {NOWHERE}
