"""A trajectory laid over keyframes: against numpy's interpolation of unwrapped yaw."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.model import KeyframeId
from eventsrc.envelope.trajectory import Trajectory, TrajectoryPose
from projections.edit.correct_poses import RunKeyframe, lay

MILLISECONDS = st.integers(0, 60_000)
METRES = st.floats(-100.0, 100.0)


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    stamps = sorted(draw(st.sets(MILLISECONDS, min_size=1, max_size=30)))
    poses = [
        TrajectoryPose(
            t / 1000, draw(METRES), draw(METRES), draw(st.floats(-3.0 * math.pi, 3.0 * math.pi)), 0
        )
        for t in stamps
    ]
    return Trajectory("file", "stamp", poses)


@given(
    trajectory=trajectories(),
    stamps=st.lists(MILLISECONDS, min_size=1, max_size=40),
    slack=st.sampled_from([0.0, 0.05, 5.0]),
)
def test_by_stamp_it_is_numpys_interpolation(
    trajectory: Trajectory, stamps: list[int], slack: float
) -> None:
    keyframes = [RunKeyframe(KeyframeId(i), t / 1000) for i, t in enumerate(stamps)]
    laid = lay(trajectory, keyframes, slack)
    at = np.array([p.key for p in trajectory.poses])
    x, y = (np.array([p[i] for p in trajectory.poses]) for i in (1, 2))
    yaw = np.unwrap([p.yaw for p in trajectory.poses])
    inside = [k for k in keyframes if at[0] - slack <= k.timestamp <= at[-1] + slack]
    assert [p.keyframe_id for p in laid.poses] == [k.keyframe_id for k in inside]
    assert set(laid.left) == {k.keyframe_id for k in keyframes} - {k.keyframe_id for k in inside}
    for pose, keyframe in zip(laid.poses, inside, strict=True):
        t = keyframe.timestamp
        assert math.isclose(pose.x, np.interp(t, at, x), abs_tol=1e-9)
        assert math.isclose(pose.y, np.interp(t, at, y), abs_tol=1e-9)
        turned = math.remainder(pose.yaw - np.interp(t, at, yaw), math.tau)
        nearest = np.diff([p.yaw for p in trajectory.poses]) / math.pi
        half_turn = np.isclose(np.abs(np.remainder(nearest, 2.0)), 1.0, atol=1e-9).any()
        assert half_turn or abs(turned) < 1e-9  # of a half turn, both ways round are the shorter


def test_the_shorter_way_round_crosses_pi() -> None:
    poses = [TrajectoryPose(0.0, 0.0, 0.0, 3.0, 1), TrajectoryPose(1.0, 0.0, 0.0, -3.0, 2)]
    laid = lay(Trajectory("file", "stamp", poses), [RunKeyframe(KeyframeId(0), 0.5)])
    assert abs(abs(laid.poses[0].yaw) - math.pi) < 1e-9
    assert laid.widest_s == 1.0


def test_by_keyframe_only_those_of_the_file_move() -> None:
    poses = [TrajectoryPose(k, float(k), 0.0, 0.0, k) for k in (2, 3, 9)]
    keyframes = [RunKeyframe(KeyframeId(k), 0.0) for k in (1, 2, 3)]
    laid = lay(Trajectory("file", "keyframe", poses), keyframes)
    assert [(p.keyframe_id, p.x) for p in laid.poses] == [(2, 2.0), (3, 3.0)]
    assert laid.left == (1,)
    assert [p.key for p in laid.unknown] == [9]


def test_a_pose_is_held_within_the_slack_and_not_beyond() -> None:
    poses = [TrajectoryPose(10.0, 1.0, 2.0, 0.5, 1), TrajectoryPose(11.0, 5.0, 2.0, 0.5, 2)]
    at = {0: 9.94, 1: 9.96, 2: 11.04, 3: 11.06}
    keyframes = [RunKeyframe(KeyframeId(k), t) for k, t in at.items()]
    laid = lay(Trajectory("file", "stamp", poses), keyframes, 0.05)
    assert [(p.keyframe_id, p.x) for p in laid.poses] == [(1, 1.0), (2, 5.0)]
    assert laid.left == (0, 3)
