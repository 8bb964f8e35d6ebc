"""Suppression, letterbox, gate and poses against slow and obvious ones."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.adapters.detector.heads import suppress
from eventsrc.adapters.detector.keyframes import GateLimits, KeyframeGate, RobotPose
from eventsrc.adapters.detector.poses import NEAR_S, PoseTrack
from eventsrc.adapters.detector.vision import Letterbox

EDGE = st.integers(0, 40)
BOX = st.tuples(EDGE, EDGE, st.integers(0, 20), st.integers(0, 20)).map(
    lambda b: (float(b[0]), float(b[1]), float(b[0] + b[2]), float(b[1] + b[3]))
)


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    wide = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
    high = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
    both = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - wide * high
    return wide * high / both if both > 0 else 0.0


def _naive(
    boxes: list[tuple[float, ...]], scores: list[float], classes: list[int], most_overlap: float
) -> list[int]:
    """Every box in order of its score; kept when no kept one of its class covers it."""
    kept: list[int] = []
    for index in sorted(range(len(boxes)), key=lambda i: (-scores[i], i)):
        rivals = [k for k in kept if classes[k] == classes[index]]
        if all(_overlap(boxes[k], boxes[index]) <= most_overlap for k in rivals):
            kept.append(index)
    return kept


@given(
    st.lists(st.tuples(BOX, st.sampled_from([0.3, 0.5, 0.5, 0.9]), st.integers(0, 2)), max_size=25),
    st.sampled_from([0.0, 0.3, 0.5, 1.0]),
    st.integers(1, 30),
)
def test_suppression_is_the_slow_one(
    found: list[tuple[tuple[float, ...], float, int]], most_overlap: float, most: int
) -> None:
    boxes = [box for box, _, _ in found]
    scores, classes = [s for _, s, _ in found], [c for _, _, c in found]
    expected = _naive(boxes, scores, classes, most_overlap)
    kept = suppress(
        np.array(boxes, np.float64).reshape(-1, 4),
        np.array(scores, np.float64),
        np.array(classes, np.intp),
        max_overlap=most_overlap,
        most=most,
    )
    assert kept.indices == expected[:most]
    # What is cut was not looked at any more: at least those that would have been kept.
    assert kept.cut >= len(expected) - len(kept.indices)
    assert (kept.cut > 0) == (len(expected) > most) or len(expected) <= most


@given(
    st.integers(1, 8000),
    st.integers(1, 8000),
    st.tuples(st.integers(32, 1280), st.integers(32, 1280)),
    st.booleans(),
    st.tuples(*[st.floats(0.0, 1.0)] * 4),
)
def test_a_letterbox_is_undone(
    width: int, height: int, size: tuple[int, int], centred: bool, at: tuple[float, ...]
) -> None:
    box = Letterbox.of(width, height, size, centred=centred)
    assert 1 <= box.inner[0] <= size[0]
    assert 1 <= box.inner[1] <= size[1]
    assert box.inner[0] == size[0] or box.inner[1] == size[1]
    in_picture = np.array([at]) * np.array((width, height) * 2)
    laid = in_picture * np.array(box.scale * 2) + np.array(box.offset * 2)
    assert (laid >= 0).all()
    assert (laid <= np.array(size * 2) + 1e-6).all()
    assert np.allclose(box.to_picture(laid), in_picture, atol=1e-6)


def test_boxes_beyond_the_picture_are_cut_to_it() -> None:
    box = Letterbox.of(640, 400, (640, 640), centred=True)
    assert box.offset == (0, 120)
    cut = box.to_picture(np.array([[-50.0, 100.0, 700.0, 600.0]]))
    assert cut.tolist() == [[0.0, 0.0, 640.0, 400.0]]


POSE = st.builds(
    RobotPose,
    st.floats(-3, 3, allow_nan=False),
    st.floats(-3, 3, allow_nan=False),
    st.floats(-10, 10, allow_nan=False),
)
PICTURES = st.lists(st.tuples(st.floats(0, 30), st.none() | POSE), max_size=40)


def _naive_keyframes(
    pictures: list[tuple[float, RobotPose | None]], limits: GateLimits
) -> list[int]:
    """Each picture judged by the whole list of keyframes so far."""
    chosen: list[int] = []
    for index, (stamp, pose) in enumerate(pictures):
        posed = [pictures[k][1] for k in chosen if pictures[k][1] is not None]
        due = not chosen or (pose is not None and not posed)
        if chosen and limits.after_s is not None:
            due = due or abs(stamp - pictures[chosen[-1]][0]) >= limits.after_s
        if pose is not None and posed:
            last = posed[-1]
            assert last is not None
            angle = abs(pose.yaw - last.yaw) % (2 * math.pi)
            angle = min(angle, 2 * math.pi - angle)
            far = math.sqrt((pose.x - last.x) ** 2 + (pose.y - last.y) ** 2)
            due = due or far >= limits.moved_m - 1e-6 or angle >= limits.turned_rad - 1e-6
        if due:
            chosen.append(index)
    return chosen


@given(PICTURES, st.none() | st.floats(0.5, 10))
def test_the_gate_is_the_naive_one(
    pictures: list[tuple[float, RobotPose | None]], after_s: float | None
) -> None:
    limits = GateLimits(after_s=after_s)
    gate = KeyframeGate(limits)
    chosen = []
    for index, (stamp, pose) in enumerate(pictures):
        if gate.is_due(stamp, pose):
            gate.set_last(stamp, pose)
            chosen.append(index)
    assert chosen == _naive_keyframes(pictures, limits)


def test_half_a_metre_in_steps_is_half_a_metre() -> None:
    gate = KeyframeGate(GateLimits(after_s=None))
    taken = 0
    x = 0.0
    for step in range(101):
        if gate.is_due(float(step), RobotPose(x, 0.0, 3.1)):
            gate.set_last(float(step), RobotPose(x, 0.0, 3.1))
            taken += 1
        x += 0.05
    assert taken == 11


STAMPS = st.lists(
    st.integers(0, 2000).map(lambda ms: ms / 1000), min_size=0, max_size=20, unique=True
)


@given(STAMPS, st.integers(0, 2000).map(lambda ms: ms / 1000), st.randoms())
def test_a_picture_has_the_pose_of_its_time(stamps: list[float], at: float, rng: object) -> None:
    """The robot drives and turns evenly, so that between two poses it is where the clock says."""

    def truth(stamp: float) -> RobotPose:
        return RobotPose(stamp, -2 * stamp, math.remainder(3 * stamp, math.tau))

    track = PoseTrack()
    shuffled = list(stamps)
    rng.shuffle(shuffled)  # type: ignore[attr-defined]
    for stamp in shuffled:
        track.add(stamp, truth(stamp))
    found = track.at(at)
    near = sorted((s for s in stamps if abs(s - at) <= NEAR_S + 1e-6), key=lambda s: abs(s - at))
    if not near:
        assert found is None
        return
    assert found is not None
    before = [s for s in near if s < at]
    after = [s for s in near if s >= at]
    expected = truth(at) if before and after else truth(near[0])
    assert math.dist(found[:2], expected[:2]) < 1e-9
    assert abs(math.remainder(found.yaw - expected.yaw, math.tau)) < 1e-9


@pytest.mark.parametrize("first", [3.1, -3.1])
def test_a_turn_through_the_back_is_short(first: float) -> None:
    track = PoseTrack()
    track.add(1.0, RobotPose(0, 0, first))
    track.add(1.1, RobotPose(0, 0, -first))
    found = track.at(1.05)
    assert found is not None
    assert abs(abs(found.yaw) - math.pi) < 1e-9
