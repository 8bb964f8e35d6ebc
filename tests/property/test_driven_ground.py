"""Driven ground against pairs of poses gone through one by one."""

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.ask.driven_ground import DrivenGround
from projections.fold.corrections import NO_CORRECTIONS
from projections.fold.settings import Settings
from projections.map.records import KeyframeRecord
from projections.map.view import MapView
from projections.store.history import History
from projections.store.stored_view import StoredView
from projections.store.tables import Tables, TableWriter
from tests.support.envelopes import envelope
from tests.support.folds import Folded
from tests.support.thorough import examples

Square = tuple[str | None, int, int]
EIGHTHS = st.integers(-20, 20).map(lambda n: n / 8)
POSES = st.lists(
    st.tuples(
        st.sampled_from(["a", "b"]),
        st.integers(0, 60),
        st.none() | st.tuples(EIGHTHS, EIGHTHS),
        st.sampled_from([None, None, "1"]),
    ),
    max_size=25,
    unique_by=lambda each: each[:2],
)


def no_map(offset: Offset) -> OccupancyMap:
    raise AssertionError(offset)


def square(keyframe: KeyframeRecord) -> Square:
    x, y = spot(keyframe)
    return keyframe.floor, math.floor(x * 4), math.floor(y * 4)


def spot(keyframe: KeyframeRecord) -> tuple[float, float]:
    assert keyframe.pose is not None
    return keyframe.pose.x_um / 1e6, keyframe.pose.y_um / 1e6


def lengths_by_hand(view: MapView) -> tuple[list[KeyframeRecord], list[list[float]]]:
    """The first pose of each square, and the lengths of the shortest ways between them."""
    driven = [k for k in view.keyframes if k.pose is not None]
    driven.sort(key=lambda k: (k.run, k.keyframe_id))
    first: dict[Square, KeyframeRecord] = {}
    for keyframe in driven:
        first.setdefault(square(keyframe), keyframe)
    nodes, number = list(first.values()), {each: n for n, each in enumerate(first)}
    away = [[math.dist(spot(a), spot(b)) for b in nodes] for a in nodes]
    lengths = [
        [
            away[a][b] if away[a][b] <= 0.75 and x.floor == y.floor else math.inf
            for b, y in enumerate(nodes)
        ]
        for a, x in enumerate(nodes)
    ]
    for before, after in pairwise(driven):
        a, b = number[square(before)], number[square(after)]
        if before.run == after.run and away[a][b] <= 5.0:
            lengths[a][b] = lengths[b][a] = away[a][b]
    for middle in range(len(nodes)):
        for a in range(len(nodes)):
            for b in range(len(nodes)):
                longer = lengths[a][middle] + lengths[middle][b]
                lengths[a][b] = min(lengths[a][b], longer)
    return nodes, lengths


def test_a_point_far_from_driven_ground_is_refused() -> None:
    view = Folded.start(Settings()).extend([envelope(n, n / 4) for n in range(9)]).view
    ground = DrivenGround(view)
    assert ground.spots[ground.nearest((2.0, 9.9))] == (2.0, 0.0)
    with pytest.raises(MisuseError, match="2,-50 is 50 m from where robots have driven"):
        ground.nearest((2.0, -50.0))


@given(poses=POSES)
@settings(max_examples=examples(200))
def test_ways_go_from_pose_to_pose_and_to_those_beside(poses: list[Any]) -> None:
    folded = Folded.start()
    writer = TableWriter(Tables())
    for run, number, at, floor in poses:
        document = envelope(number, *(at or (None, None)), run_id=run)
        folded.extend([document if floor is None else document | {"floor": floor}])
    for offset, deltas in enumerate(folded.deltas):
        writer.add(Offset(offset), deltas)
    history = History(Settings(), NO_CORRECTIONS, Tables(writer.finish()), no_map)
    kept = StoredView(history, Offset(len(folded.deltas)))
    nodes, lengths = lengths_by_hand(folded.view)
    for view in (folded.view, kept):
        ground = DrivenGround(view)
        numbers = range(len(nodes))
        assert [ground.keyframe(n).ordinal for n in numbers] == [k.ordinal for k in nodes]
        assert ground.spots == [spot(k) for k in nodes]
        for a in numbers:
            found, _ = ground.lengths_from(a)
            reached = [b for b in numbers if lengths[a][b] < math.inf]
            assert sorted(found) == reached
            assert all(math.isclose(found[b], lengths[a][b], abs_tol=1e-9) for b in reached)
        if nodes:
            nearest = min(numbers, key=lambda n: (math.dist(spot(nodes[n]), (0.3, 0.2)), n))
            assert ground.nearest((0.3, 0.2)) == nearest
