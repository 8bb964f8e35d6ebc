"""Transforms over time against matrices, scipy's slerp and a plain search for the chain."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.ros.transforms import (
    MAX_FRAMES,
    BadTransform,
    Transform,
    TransformBuffer,
    compose,
    interpolate,
    invert,
    unit_transform,
)

NUMBER = st.floats(-50.0, 50.0)
GAP = 1_000


@st.composite
def transforms(draw: st.DrawFn) -> Transform:
    quaternion = draw(
        st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01)
    )
    q = np.array(quaternion) / np.linalg.norm(quaternion)
    return unit_transform(draw(NUMBER), draw(NUMBER), draw(NUMBER), *map(float, q))


def matrix(t: Transform) -> np.ndarray:
    from scipy.spatial.transform import Rotation  # takes half a second to import

    whole = np.eye(4)
    whole[:3, :3] = Rotation.from_quat(t[3:]).as_matrix()
    whole[:3, 3] = t[:3]
    return whole


def same(t: Transform, expected: np.ndarray) -> None:
    np.testing.assert_allclose(matrix(t), expected, atol=1e-6)


@given(transforms(), transforms())
def test_compose_and_invert_are_those_of_matrices(a: Transform, b: Transform) -> None:
    same(compose(a, b), matrix(a) @ matrix(b))
    same(invert(a), np.linalg.inv(matrix(a)))


def slow_interpolation(a: Transform, b: Transform, share: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation, Slerp

    turns = Rotation.from_quat([a[3:], b[3:]])
    whole = np.eye(4)
    whole[:3, :3] = Slerp([0.0, 1.0], turns)(share).as_matrix()
    whole[:3, 3] = (1.0 - share) * np.array(a[:3]) + share * np.array(b[:3])
    return whole


def half_turn(a: Transform, b: Transform) -> bool:
    """Opposite rotations: both ways round are equally short."""
    return abs(float(np.dot(a[3:], b[3:]))) < 1e-4


@given(transforms(), transforms(), st.floats(0.0, 1.0))
def test_interpolation_is_linear_and_slerp(a: Transform, b: Transform, share: float) -> None:
    if not half_turn(a, b):
        same(interpolate(a, b, share), slow_interpolation(a, b, share))


@given(transforms(), st.floats(-1e-3, 1e-3), st.floats(0.0, 1.0))
def test_interpolation_of_nearly_equal_rotations(a: Transform, angle: float, share: float) -> None:
    turn = Transform(0.0, 0.0, 0.0, 0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2)))
    b = compose(a, turn)
    same(interpolate(a, b, share), slow_interpolation(a, b, share))


FRAMES = ("map", "odom", "base", "camera", "other")


@st.composite
def worlds(draw: st.DrawFn):
    """Samples of a forest: a parent for each frame that has one, moving or static."""
    moving: list[tuple[str, str, int, Transform]] = []
    static: dict[str, tuple[str, Transform]] = {}
    for at, child in enumerate(FRAMES[1:], 1):
        parent = draw(st.sampled_from((None, *FRAMES[:at])))
        if parent is None:
            continue
        if draw(st.booleans()):
            static[child] = parent, draw(transforms())
            continue
        stamps = draw(st.lists(st.integers(0, 3_000), min_size=1, max_size=6, unique=True))
        moving += [(parent, child, stamp, draw(transforms())) for stamp in stamps]
    return draw(st.permutations(moving)), static


def slow_lookup(moving, static, target: str, source: str, stamp: int) -> np.ndarray | None:
    """By sorting and scanning everything; an empty array where a half turn leaves it open."""

    def up(frame: str) -> dict[str, np.ndarray | None]:
        """The pose of ``frame`` in each frame above it, None where it is not known then."""
        found: dict[str, np.ndarray | None] = {frame: np.eye(4)}
        whole: np.ndarray | None = np.eye(4)
        while True:
            if frame in static:
                parent, at = static[frame]
                step: np.ndarray | None = matrix(at)
            else:
                samples = sorted((s, p, t) for p, c, s, t in moving if c == frame)
                if not samples:
                    return found
                parent, step = samples[0][1], None
                for s, _, t in samples:
                    if s == stamp:
                        step = matrix(t)
                for (s1, _, t1), (s2, _, t2) in pairwise(samples):
                    if s1 < stamp < s2 and s2 - s1 <= GAP:
                        step = slow_interpolation(t1, t2, (stamp - s1) / (s2 - s1))
            whole = None if whole is None or step is None else step @ whole
            found[parent] = whole
            frame = parent

    from_source, from_target = up(source), up(target)
    for frame, pose in from_source.items():
        if frame in from_target:
            back = from_target[frame]
            return None if pose is None or back is None else np.linalg.inv(back) @ pose
    return None


@given(worlds(), st.sampled_from(FRAMES), st.sampled_from(FRAMES), st.integers(-10, 3_010))
def test_look_ups_are_those_of_a_plain_search(world, target, source, stamp) -> None:
    moving, static = world
    buffer = TransformBuffer(GAP)
    for child, (parent, pose) in static.items():
        buffer.add_static(parent, child, pose)
    for parent, child, at, pose in moving:
        buffer.add(parent, child, at, pose)
    by_child: dict[str, list[tuple[int, Transform]]] = {}
    for _, child, at, pose in moving:
        by_child.setdefault(child, []).append((at, pose))
    for samples in by_child.values():
        samples.sort()
        if any(half_turn(a, b) for (_, a), (_, b) in pairwise(samples)):
            return
    found, expected = buffer.lookup(target, source, stamp), None
    expected = slow_lookup(moving, static, target, source, stamp)
    if expected is None:
        assert found is None
    else:
        assert found is not None
        same(found, expected)


def test_a_circle_leads_nowhere() -> None:
    buffer = TransformBuffer(GAP)
    still = Transform(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        buffer.add_static(parent, child, still)
    assert buffer.lookup("map", "a", 0) is None
    assert buffer.lookup("a", "a", 0) is not None
    buffer.add("a", "a", 0, still)
    assert buffer.ignored == 1


def test_a_new_parent_replaces_the_old_one() -> None:
    buffer = TransformBuffer(GAP)
    for stamp, parent, x in ((0, "odom", 0.0), (100, "odom", 1.0), (200, "map", 9.0)):
        buffer.add(parent, "base", stamp, Transform(x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    assert buffer.lookup("odom", "base", 50) is None
    found = buffer.lookup("map", "base", 200)
    assert found is not None
    assert found.x == 9.0
    buffer.add("odom", "base", 150, found)  # came late
    assert (buffer.ignored, buffer.lookup("odom", "base", 150)) == (1, None)


def test_memory_is_bounded_by_samples_and_frames_whatever_the_stamps() -> None:
    buffer = TransformBuffer(GAP, max_samples=1_000)
    still = Transform(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    buffer.add("map", "base", 2**62, still)  # in the year 2116
    for stamp in range(10_000):
        buffer.add("map", "base", stamp, still)
        assert buffer.lookup("map", "base", stamp) is not None
    assert buffer._samples <= 1_000
    assert buffer._samples == sum(len(x.moving.stamps) for x in buffer._links.values())
    for number in range(2 * MAX_FRAMES):
        buffer.add("map", f"frame{number}", 0, still)
    assert len(buffer.frames()) <= MAX_FRAMES + 1
    assert buffer.ignored > MAX_FRAMES


@given(st.lists(st.sampled_from([0.0, 1.0, float("nan"), float("inf"), 1e300]), min_size=7))
def test_what_is_no_pose_is_refused(numbers: list[float]) -> None:
    x, y, z, *q = numbers[:7]
    fits = all(abs(v) <= 1e7 for v in (x, y, z)) and sum(q) == max(q) == 1.0
    try:
        unit_transform(x, y, z, *q)
    except BadTransform:
        assert not fits
    else:
        assert fits
