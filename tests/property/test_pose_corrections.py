"""Corrected poses and their normal order, against one command after another and every two
compared."""

import heapq
import math
import sys
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.commands import RigidTransform
from eventsrc.envelope.model import KeyframeId
from projections.fold.pose_corrections import Pose, PoseCorrection, PoseCorrections

IDS = st.integers(-3, 6).map(KeyframeId) | st.sampled_from(
    [KeyframeId(n) for n in (-(2**63), -300, 255, 256, 257, 2**63 - 1)]
)
NUMBERS = st.floats(-1e7, 1e7) | st.sampled_from([0.0, -0.0, 1.0, 1e-300])


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    return draw(NUMBERS), draw(NUMBERS), draw(st.floats(-1e4, 1e4))


@st.composite
def corrections(draw: st.DrawFn) -> PoseCorrection:
    if draw(st.booleans()):
        stated = draw(st.dictionaries(IDS, poses(), min_size=1, max_size=4))
        return PoseCorrection(stated, None, None, None)
    first, last = sorted((draw(IDS), draw(IDS)))
    transform = RigidTransform.of(draw(NUMBERS), draw(NUMBERS), draw(st.floats(-4.0, 4.0)))
    return PoseCorrection(
        {},
        transform,
        draw(st.sampled_from([None, first])),
        draw(st.sampled_from([None, last])),
    )


MANY = st.lists(corrections(), max_size=12)


def one_by_one(given_: list[PoseCorrection], keyframe_id: KeyframeId, pose: Pose | None) -> Any:
    for correction in given_:
        pose = correction.corrected(keyframe_id, pose)
    return pose


@given(MANY, st.lists(st.tuples(IDS, st.none() | poses()), max_size=6))
def test_poses_are_corrected_as_by_one_command_after_another(
    given_: list[PoseCorrection], logged: list[tuple[KeyframeId, Pose | None]]
) -> None:
    own = PoseCorrections(given_)
    expected = [one_by_one(given_, *each) for each in logged]
    assert repr([own.corrected(*each) for each in logged]) == repr(expected)
    assert repr(own.corrected_poses(logged)) == repr(expected)


def test_a_pose_out_of_all_bounds_is_that_of_one_command_after_another() -> None:
    far = PoseCorrection({}, RigidTransform.of(1e7, -1e7, 1e4), None, None)
    huge = (sys.float_info.max, -sys.float_info.max, 0.0)
    given_, own = [far] * 100, PoseCorrections([far] * 100)
    expected = repr([one_by_one(given_, KeyframeId(1), huge)])
    assert repr([own.corrected(KeyframeId(1), huge)]) == expected
    assert repr(own.corrected_poses([(KeyframeId(1), huge)])) == expected


def every_two_compared(given_: list[PoseCorrection]) -> list[Any]:
    """The normal order by definition: the smallest row of those before which none is left that has
    a keyframe in common with it."""

    def row(each: PoseCorrection) -> tuple[Any, ...]:
        numbers = () if each.transform is None else tuple(each.transform.model_dump().values())
        bounds = [() if bound is None else (bound,) for bound in (each.first, each.last)]
        return sorted(each.poses.items()), numbers, *bounds

    def meet(one: PoseCorrection, other: PoseCorrection) -> bool:
        if one.transform is None and other.transform is None:
            return not one.poses.keys().isdisjoint(other.poses)
        if one.transform is not None and other.transform is not None:
            return max(one.span[0], other.span[0]) <= min(one.span[1], other.span[1])
        stated, moved = (one, other) if one.transform is None else (other, one)
        return any(moved.span[0] <= k <= moved.span[1] for k in stated.poses)

    left, ordered = dict(enumerate(given_)), []
    while left:
        ready = [
            (row(each), n)
            for n, each in left.items()
            if not any(m < n and meet(other, each) for m, other in left.items())
        ]
        heapq.heapify(ready)
        ordered.append(ready[0][0])
        del left[ready[0][1]]
    return ordered


@given(MANY)
def test_the_normal_order_is_that_of_every_two_compared(given_: list[PoseCorrection]) -> None:
    assert PoseCorrections(given_).normal_order == every_two_compared(given_)


def moved(first: int | None, last: int | None, number: int) -> PoseCorrection:
    transform = RigidTransform.of(number / 8, 0.0, 0.25)
    low, high = (None if k is None else KeyframeId(k) for k in (first, last))
    return PoseCorrection({}, transform, low, high)


def stated(*keyframe_ids: int) -> PoseCorrection:
    return PoseCorrection({KeyframeId(k): (0.0, 0.0, 0.0) for k in keyframe_ids}, None, None, None)


@pytest.mark.parametrize(
    "make",
    [
        lambda n: [moved(None, None, k) for k in range(n)],
        lambda n: [moved(k, n + k, k) for k in range(n)],
        lambda n: [moved(k, 2 * n - k, k) for k in range(n)],
        lambda n: [stated(*range(k % 5, 20)) for k in range(n)],
        lambda n: [stated(k, n) if k % 2 else moved(0, k, k) for k in range(n)],
        lambda n: [stated(7 * k, 7 * k + 1) if k % 3 else moved(k, None, k) for k in range(n)],
    ],
)
def test_twice_the_commands_are_about_twice_the_work(
    make: Callable[[int], list[PoseCorrection]],
) -> None:
    def calls(count: int) -> int:
        own, number = PoseCorrections(make(count)), 0

        def count_call(_: Any, event: str, __: Any) -> None:
            nonlocal number
            number += event in ("call", "c_call")

        sys.setprofile(count_call)
        try:
            _ = own.normal_order
            own.corrected_poses([(KeyframeId(k), (1.0, 2.0, 3.0)) for k in range(20)])
        finally:
            sys.setprofile(None)
        return number

    assert calls(400) < 2.6 * calls(200)


def test_known_answers_of_many_transforms() -> None:
    own = PoseCorrections([*(moved(None, None, 8) for _ in range(100)), stated(4), moved(4, 4, 8)])
    x, y, yaw = own.corrected_poses([(KeyframeId(4), (9.0, 9.0, 9.0))])[0] or (0.0, 0.0, 0.0)
    assert (x, y, yaw) == (1.0, 0.0, 0.25)
    turned = own.corrected(KeyframeId(5), (0.0, 0.0, 0.0))
    assert turned is not None
    assert math.isclose(turned[2], 25.0)
