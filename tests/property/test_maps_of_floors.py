"""Occupancy maps of floors: a log of several floors is folded as one log for each floor is, and
walls in re-localisation are those of the floor that a position is on."""

import random
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold import free_floor
from projections.fold.settings import Settings
from projections.localize.relocalize import CandidatePlace, MapCandidates, Match
from projections.localize.relocalize.ground import WallMap
from projections.localize.relocalize.layout import STEP_M, Layout
from projections.map.digest import map_digest
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, resumed, state_bytes
from tests.support.thorough import examples

ROOMS = Settings(places="rooms")
FULL = Settings(places="rooms", fusion="evidence")
LOOKS = dict(zip(("bed", "cup", "tv"), np.eye(3, 8), strict=True))
Item = dict[str, Any] | OccupancyMap


def _map(rng: random.Random, floor: str | None) -> OccupancyMap:
    """Some walls on 12 m by 12 m about the origin."""
    cells = np.zeros((48, 48), np.uint8)
    for _ in range(rng.randrange(1, 6)):
        row, column = rng.randrange(48), rng.randrange(48)
        cells[row, column : column + 24] = 100
        cells[row : row + 24, column] = 100
    origin = (-6.0, -6.0, rng.choice([0.0, 0.4]))
    return OccupancyMap(None, 0.25, origin, "drawn", cells, floor)


def _items(seed: int) -> list[Item]:
    """Two robots, each on a floor, and maps of the floors, the first floor's with or without its
    name; what comes first is of the floor "0"."""
    rng = random.Random(seed)
    at = {"0": [0.0, 0.0], "1": [0.0, 0.0]}
    items: list[Item] = []
    for number in range(rng.randrange(20, 70)):
        floor = rng.choice("01") if number else "0"
        if number and rng.random() < 0.08:
            items.append(_map(rng, rng.choice([None, "0"]) if floor == "0" else "1"))
            if rng.random() < 0.3:
                items.append(items[-1])  # published again
        for axis in (0, 1):
            at[floor][axis] = max(-5.5, min(5.5, at[floor][axis] + rng.uniform(-1.2, 1.2)))
        seen = [
            detection(name, LOOKS[name], bbox=[left, 200.0, left + 80.0, 290.0])
            for name in rng.sample(sorted(LOOKS), rng.randrange(3))
            for left in [rng.uniform(50.0, 500.0)]
        ]
        fields = {"floor": floor, "run_id": f"run-{floor}", "detections": seen}
        items.append(envelope(number, *at[floor], **fields))
    return items


def _fold(items: Iterable[Item], settings: Settings = ROOMS) -> Folded:
    folded = Folded.start(settings)
    for item in items:
        if isinstance(item, OccupancyMap):
            offset = folded.map.next_offset
            folded.view.apply_event(offset, folded.map.use_map(offset, item))
        else:
            folded.extend([item])
    return folded


def _of_floor(items: list[Item], floor: str) -> list[Item]:
    """What a log of this floor alone would have. Its map is one that names no floor; of the first
    floor one that names it goes before those that do not, so these are left out from then on."""
    found, has_named = list[Item](), False
    for item in items:
        if not isinstance(item, OccupancyMap):
            found += [item] if item["floor"] == floor else []
        elif item.floor == floor or (item.floor is None and floor == "0" and not has_named):
            has_named |= item.floor is not None
            about = item.map_id, item.resolution, item.origin, item.source
            found.append(OccupancyMap(*about, item.cells))
    return found


def _partition(folded: Folded, floor: str) -> set[frozenset[int]]:
    """Keyframe ids by place, on a floor."""
    groups: dict[int | None, set[int]] = {}
    for keyframe in folded.view.keyframes:
        if keyframe.floor == floor:
            groups.setdefault(keyframe.place, set()).add(keyframe.keyframe_id)
    return set(map(frozenset, groups.values()))


@settings(max_examples=examples(25), deadline=None)
@given(st.integers(0, 10**6))
def test_each_floor_is_folded_as_if_it_were_alone(seed: int) -> None:
    items = _items(seed)
    whole = _fold(items)
    for floor in {item["floor"] for item in items if isinstance(item, dict)}:
        assert _partition(whole, floor) == _partition(_fold(_of_floor(items, floor)), floor)


@settings(max_examples=examples(10), deadline=None)
@given(st.integers(0, 10**6))
def test_kept_folds_have_the_maps_of_all_floors(seed: int) -> None:
    items, rules = _items(seed), (ROOMS, FULL)[seed % 2]
    half = _fold(items[: len(items) // 2], rules)
    again = resumed(half)
    for item in items[len(items) // 2 :]:
        if isinstance(item, OccupancyMap):
            offset = again.map.next_offset
            again.view.apply_event(offset, again.map.use_map(offset, item))
        else:
            again.extend([item])
    whole = _fold(items, rules)
    assert map_digest(again.view) == map_digest(whole.view)
    assert state_bytes(again) == state_bytes(whole)
    offsets = [
        {f: g.offset for f, g in v.maps_in_force().items()} for v in (again.view, whole.view)
    ]
    assert offsets[0] == offsets[1]


def test_walls_are_worked_out_when_a_pose_needs_them(monkeypatch: pytest.MonkeyPatch) -> None:
    built = []

    class Counted(free_floor.OccupancyGrid):
        def __init__(self, source: OccupancyMap) -> None:
            built.append(source)
            super().__init__(source)

    monkeypatch.setattr(free_floor, "OccupancyGrid", Counted)
    rng = random.Random(1)
    maps = [_map(rng, None) for _ in range(20)] + [_map(rng, "1") for _ in range(20)]
    folded = _fold([*maps, envelope(0, None, None)])
    assert built == []
    again = OccupancyMap(None, 0.25, maps[19].origin, "elsewhere", maps[19].cells.copy())
    for _ in range(3):
        assert folded.map.use_map(folded.map.next_offset, again) == []
    folded.extend(envelope(k, 0.1 * k, 0.0, floor="0") for k in range(1, 6))
    assert built == [maps[19]]
    folded.map.use_map(folded.map.next_offset, again)
    folded.extend(envelope(k, 0.1 * k, 0.0, floor="1") for k in range(6, 12))
    assert built == [maps[19], maps[39]]
    assert [given.offset for given in folded.view.maps_in_force().values()] == [19, 39]
    page = Folded.start(Settings())
    page.map.use_map(0, maps[0])
    page.extend([envelope(0)])
    assert len(built) == 2, "places=page does not use walls"


def test_a_map_of_a_floor_that_no_pose_is_on_is_kept_and_waits() -> None:
    rng = random.Random(3)
    upstairs = _map(rng, "1")
    folded = _fold([upstairs, *(envelope(k, 0.2 * k, 0.0, floor="0") for k in range(4))])
    assert folded.view.map is None
    assert list(folded.view.maps_in_force()) == ["1"]


@settings(max_examples=examples(25), deadline=None)
@given(st.integers(0, 10**6))
def test_walls_in_an_answer_are_those_of_the_floor(seed: int) -> None:
    rng, numbers = random.Random(seed), np.random.default_rng(seed)
    names = ["0", "1", None]
    walls = {floor: WallMap(_map(rng, None)) for floor in names if rng.random() < 0.7}
    layout = Layout.of(_candidates(names))
    laid = layout.walls(walls)
    if not walls:
        assert laid is None
        return
    assert laid is not None
    xy, things = numbers.uniform(-7, 7, (30, 2)), numbers.uniform(-7, 7, (12, 2))
    of_xy, of_things = numbers.integers(0, 3, 30), numbers.integers(0, 3, 12)
    asked = numbers.random((12, 30)) < 0.8
    moved = [
        at + np.stack([of * STEP_M, of * 0.0], axis=1)
        for at, of in ((xy, of_xy), (things, of_things))
    ]
    inside, hidden = laid.contains(moved[0]), laid.hides(moved[1], moved[0], asked)
    for number, name in enumerate(names):
        near, there = np.flatnonzero(of_things == number), np.flatnonzero(of_xy == number)
        own, here = walls.get(name), np.ix_(near, there)
        if own is None or not len(there):
            assert not inside[there].any()
            assert not hidden[here].any()
        else:
            assert inside[there].tolist() == own.contains(xy[there]).tolist()
            assert np.array_equal(hidden[here], own.hides(things[near], xy[there], asked[here]))
    assert not hidden[of_things[:, None] != of_xy].any(), "only walls of one floor hide"


def test_without_several_floors_the_map_of_the_only_one_counts() -> None:
    one, other = (WallMap(_map(random.Random(seed), None)) for seed in (1, 2))
    assert Layout.of(_candidates(["1"])).walls({"0": one, "1": other}) is other
    assert Layout.of(_candidates(["2"])).walls({"0": one, "1": other}) is None
    assert Layout.of(_candidates([])).walls({"1": other}) is other
    assert Layout.of(_candidates([])).walls({"0": one, "1": other}) is None


def _candidates(floors: list[str | None]) -> MapCandidates:
    """A match on each floor, and places of the map that no match is in."""
    matches = tuple(
        Match(n, f"d{n}", "r", 1.0, (0.0, 0.0, 0.0), None, "cup", None, None, n)
        for n in range(len(floors))
    )
    places = {n: CandidatePlace(f"p{n}", 0.0, 0.0, None, floor) for n, floor in enumerate(floors)}
    return MapCandidates((matches,), {**places, 99: CandidatePlace("p99", 0.0, 0.0, None, "9")})
