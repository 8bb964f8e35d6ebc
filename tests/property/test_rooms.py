"""Places by rooms equal their rules, done naively, after every keyframe."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.corrections import Keyframe
from projections.fold.deltas import (
    KeyframePlaced,
    MergeRefused,
    PlaceChanged,
    PlaceFormed,
    PlacesMerged,
)
from projections.fold.pair_groups import ApartPairs, PairGroups, without_contradictions
from projections.fold.place_members import PosedKeyframe
from projections.fold.rooms import Rooms
from tests.support.naive_places import NaiveRooms
from tests.support.thorough import stride

CELL_UM, DRIVE_UM = 750, 4000
At = tuple[int, int, int]
"""Run, x and y."""
Statements = list[tuple[tuple[int, int], bool]]


@st.composite
def drives(draw: st.DrawFn) -> list[At]:
    """Robots that walk a lattice, by turns; coarse ones have many equal distances."""
    step = draw(st.sampled_from([CELL_UM // 3, CELL_UM // 2, CELL_UM, CELL_UM + 1, 997]))
    runs = draw(st.integers(1, 3))
    at = {run: (draw(st.integers(-3, 3)), draw(st.integers(-3, 3))) for run in range(runs)}
    moves = st.tuples(
        st.integers(0, runs - 1),
        st.sampled_from(
            [(0, 0), (1, 0), (1, 0), (0, 1), (-1, 0), (0, -1), (2, 1), (6, 0), (-4, 5)]
        ),
    )
    points = []
    for run, (dx, dy) in draw(st.lists(moves, max_size=40)):
        x, y = at[run]
        at[run] = x + dx, y + dy
        points.append((run, at[run][0] * step, at[run][1] * step))
    return points


def building(seed: int) -> list[At]:
    """A robot that drives about some rooms on a line, and through them again."""
    rng = random.Random(seed)
    points, runs = [], rng.choice([1, 2, 3])
    for run in range(runs):
        x, y = 0, rng.randrange(2_000)
        for _ in range(rng.randrange(5, 40)):
            room = rng.randrange(-6_000, 12_000)
            while abs(room - x) > 900:
                x += 900 if room > x else -900
                points.append((run, x + rng.randrange(-100, 100), y))
            y += rng.randrange(-1_500, 1_500)
            points.append((run, x, y))
    return points[:90]


def told(seed: int, count: int) -> Statements:
    """Pairs of points that are one (true) or kept apart, without contradictions."""
    rng = random.Random(seed)
    few = rng.sample(range(count), min(rng.choice([2, 4, 7]), count))
    wanted = []
    for _ in range(rng.randrange(0, 8) if len(few) > 1 else 0):
        a, b = sorted(rng.sample(few, 2))
        wanted.append(((a, b), rng.random() < 0.4))
    joined, apart = without_contradictions(wanted)
    return [(pair, True) for pair in joined] + [(pair, False) for pair in apart]


def rooms_of(statements: Statements, way=None) -> Rooms:
    joined, apart = (
        [(Keyframe("r", a), Keyframe("r", b)) for (a, b), is_same in statements if is_same is want]
        for want in (True, False)
    )
    return Rooms(
        CELL_UM, DRIVE_UM, PairGroups(joined, ApartPairs.of(apart)), way and (lambda _: way)
    )


def fold_one(rooms: Rooms, n: int, at: At) -> list:
    run, x, y = at
    rooms.add_anchor(n, Keyframe("r", n))
    return rooms.fold(PosedKeyframe(n, n, run, f"r{run}", x, y))


def check_every_prefix(
    points: list[At], statements: Statements, way=None, known_from: int = 0
) -> None:
    """Walls are known from a point on."""
    rooms = rooms_of(statements)
    joined, apart = ([p for p, is_same in statements if is_same is w] for w in (True, False))
    naive = NaiveRooms(CELL_UM, DRIVE_UM, joined, apart)
    founders: list[int] = []
    refused: set[tuple[int, int]] = set()
    for n, at in enumerate(points):
        if n == known_from:
            rooms.use_walls(way and (lambda _: way))
            naive.way = way
        deltas = fold_one(rooms, n, at)
        naive.add(*at)
        ours = [rooms.label(i) for i in range(n + 1)]
        assert ours == naive.labels
        founders += [d.founder for d in deltas if type(d) is PlaceFormed]
        assert founders == naive.founders
        assert [d.keyframe for d in deltas if type(d) is KeyframePlaced] == [n]
        check_merges([d for d in deltas if type(d) is PlacesMerged], naive, n)
        for delta in deltas:
            if type(delta) is MergeRefused:
                assert (delta.a, delta.b) not in refused
                refused.add((delta.a, delta.b))
                after = [rooms.survivors.find(place) for place in (delta.a, delta.b)]
                assert [rooms.place_of(k) for k in delta.apart] == after
        assert refused == naive.refused
        changed = {d.place: d for d in deltas if type(d) is PlaceChanged}
        assert ours[n] in changed
        for place, d in changed.items():
            own = [points[i] for i, label in enumerate(ours) if label == place]
            sums = sum(x for _, x, _ in own), sum(y for _, _, y in own)
            assert (d.keyframe_count, d.sum_x_um, d.sum_y_um) == (len(own), *sums)
        if n % 3 == 0:
            restored = rooms_of(statements, way if n >= known_from else None)
            restored.load(rooms.dump())
            rooms = restored


def check_merges(merges: list[PlacesMerged], naive: NaiveRooms, n: int) -> None:
    """What merges tell is what the naive rules say, and links are of cells of the two sides."""
    assert [(m.survivor, *m.absorbed) for m in merges] == [each[:2] for each in naive.merges]
    drives = naive._drives()
    for merge, (_, absorbed, mean) in zip(merges, naive.merges, strict=True):
        (link,) = merge.links
        assert merge.bridge == n
        if mean is None:
            assert (merge.joined, merge.drives) == ((absorbed,), ())
            continue
        (drive,) = merge.drives
        assert drive.mean_um == int(mean)
        cells = [naive.points[end] for end in (link.core, link.neighbour)]
        assert drives[cells[0]][cells[1]] == link.distance_um < 2 * DRIVE_UM


@given(points=drives())
def test_drives_equal_the_naive_rules(points: list[At]) -> None:
    check_every_prefix(points, [])


@given(points=drives(), seed=st.integers(0, 2**32))
def test_drives_with_commands_equal_the_naive_rules(points: list[At], seed: int) -> None:
    check_every_prefix(points, told(seed, len(points)))


def test_a_keyframe_kept_apart_enters_a_cell_before_its_way_there_merges_places() -> None:
    points = [(0, 0, 0), (1, 0, -751), (0, 0, 0), (0, 0, -751)]
    check_every_prefix(points, [((0, 2), False), ((0, 3), False), ((2, 3), False)])


@pytest.mark.parametrize("seed", range(0, 12, stride(12)))
def test_buildings_equal_the_naive_rules(seed: int) -> None:
    points = building(seed)
    check_every_prefix(points, told(seed, len(points)) if seed % 2 else [])


def _way(a: tuple[int, int], b: tuple[int, int]) -> int | None:
    """A wall along x = 1,500 with a door at y = 0; beyond it ways count as a third."""
    length = math.isqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2)
    if (a[0] < 1500) != (b[0] < 1500):
        return length if a[1] == b[1] == 0 else None
    return length if a[0] < 1500 else length // 3


@given(points=drives())
def test_drives_between_walls_equal_the_naive_rules(points: list[At]) -> None:
    check_every_prefix(points, [], _way)


@given(points=drives(), seed=st.integers(0, 2**32), known_from=st.integers(0, 30))
def test_walls_that_become_known_count_from_then_on(
    points: list[At], seed: int, known_from: int
) -> None:
    check_every_prefix(points, told(seed, len(points)), _way, known_from)


@pytest.mark.parametrize("seed", range(0, 8, stride(5)))
def test_buildings_with_walls_equal_the_naive_rules(seed: int) -> None:
    points = building(seed)
    check_every_prefix(points, told(seed, len(points)) if seed % 2 else [], _way, 20 * (seed % 3))


def test_buildings_have_merges_and_refusals() -> None:
    """The worlds of these tests are ones in which something happens."""
    merged = refused = joined = 0
    for seed in range(30):
        points = building(seed)
        rooms = rooms_of(told(seed, len(points)))
        deltas = [d for n, at in enumerate(points) for d in fold_one(rooms, n, at)]
        merged += sum(type(d) is PlacesMerged and not d.joined for d in deltas)
        joined += sum(type(d) is PlacesMerged and bool(d.joined) for d in deltas)
        refused += sum(type(d) is MergeRefused for d in deltas)
    assert min(merged, refused, joined) >= 5, (merged, refused, joined)


@given(points=drives())
def test_no_cell_is_near_itself_and_nearness_is_mutual(points: list[At]) -> None:
    rooms = rooms_of([])
    for n, at in enumerate(points):
        fold_one(rooms, n, at)
    near = rooms._cells.near
    assert all(cell not in each for cell, each in enumerate(near))
    assert all(
        near[b][a] == d < 2 * DRIVE_UM for a, each in enumerate(near) for b, d in each.items()
    )
