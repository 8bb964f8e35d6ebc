"""Tracking: properties of the filter, on made-up posteriors and on drives through a building."""

import math
from collections import Counter
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.localize.relocalize import Answer, PoseHypothesis, Question, QuestionView, rank
from projections.localize.relocalize.layout import Hypotheses
from projections.localize.relocalize.question import MAX_CROPS, Movement
from projections.localize.relocalize.reading import MAX_MOVED_M, MAX_TURNED_RAD
from projections.localize.relocalize.track import PARTICLES, Track, _resampled, movement_of
from tests.support.buildings import Building, Keyframe, drive
from tests.support.scenes import RoomMap, crops_of
from tests.support.thorough import examples, mostly_slow

STILL = (0.0, 0.0, 0.0)
SEEDS = (3, 5)


def hypotheses(*poses: tuple[float, ...], floor: str | None = None) -> Hypotheses:
    """Poses (x, y, yaw, weight)."""
    rows = np.array(poses, dtype=np.float64)
    weights = rows[:, 3] / rows[:, 3].sum()
    return Hypotheses(rows[:, :3], weights, (floor,) * len(rows))


coordinates = st.floats(-1e7, 1e7) | st.floats(-5.0, 5.0)
angles = st.floats(-math.pi, math.pi)
seen = st.lists(
    st.tuples(coordinates, coordinates, angles, st.floats(1e-6, 1.0)), min_size=1, max_size=6
).map(lambda poses: hypotheses(*poses))
moves = st.tuples(
    st.floats(-MAX_MOVED_M, MAX_MOVED_M),
    st.floats(-MAX_MOVED_M, MAX_MOVED_M),
    st.floats(-MAX_TURNED_RAD, MAX_TURNED_RAD),
)
shares = st.floats(0.0, 1.0)
steps = st.lists(st.tuples(moves, st.none() | seen, shares, shares), min_size=1, max_size=8)


@given(steps)
@settings(max_examples=examples(60), deadline=None)
def test_hostile_odometry_and_answers_leave_a_sound_filter(
    given_steps: list[tuple[Movement, Hypotheses | None, float, float]],
) -> None:
    track, answered = Track("robot"), False
    for moved, found, confidence, known in given_steps:
        tracked = track.step(moved, found, confidence, known)
        answered, pose = answered or found is not None, tracked.pose
        assert (pose is not None) == answered
        assert 0.0 <= tracked.confidence <= 1.0
        assert 0.0 < track.lost <= 1.0
        assert len(track.particles) == (PARTICLES if answered else 0)
        assert np.isfinite(track.particles).all()
        assert (np.abs(track.particles[:, 2]) <= math.pi + 1e-9).all()
        if pose is not None:
            assert math.isfinite(pose.x)
            assert math.isfinite(pose.y)
            assert math.isfinite(pose.spread_m)


@given(steps, st.text(max_size=20))
@settings(max_examples=examples(20), deadline=None)
def test_the_same_session_is_the_same_to_the_last_bit(
    given_steps: list[tuple[Movement, Hypotheses | None, float, float]], name: str
) -> None:
    one, other = Track(name), Track(name)
    for moved, found, confidence, known in given_steps:
        assert one.step(moved, found, confidence, known) == other.step(
            moved, found, confidence, known
        )
    assert one.particles.tobytes() == other.particles.tobytes()


def test_sessions_of_other_names_draw_other_numbers() -> None:
    found = hypotheses((1.0, 2.0, 0.5, 1.0))
    first, second = (Track(name).step(STILL, found, 0.9) for name in ("a", "b"))
    assert first != second


@given(
    st.lists(st.floats(0.0, 1.0), min_size=1, max_size=50).filter(lambda w: sum(w) > 1e-3),
    st.integers(1, 500),
    st.integers(0, 2**32),
)
@settings(max_examples=examples(200), deadline=None)
def test_resampling_takes_each_as_often_as_its_weight_says(
    weights: list[float], count: int, seed: int
) -> None:
    shares = np.array(weights) / sum(weights)
    drawn = Counter(_resampled(shares, count, np.random.default_rng(seed)).tolist())
    assert sum(drawn.values()) == count
    for index, share in enumerate(shares.tolist()):
        assert abs(drawn[index] - share * count) <= 1.0 + 1e-6


@given(st.lists(moves, min_size=1, max_size=6))
def test_movements_of_views_add_up(given_moves: list[Movement]) -> None:
    """Complex numbers as the oracle."""
    views = tuple(QuestionView(*moved, ()) for moved in given_moves[1:])
    question = Question((QuestionView(9.0, 9.0, 9.0, ()), *views))
    at, heading = 0j, 1 + 0j
    for dx, dy, dyaw in given_moves:
        at += heading * complex(dx, dy)
        heading *= complex(math.cos(dyaw), math.sin(dyaw))
    x, y, yaw = movement_of(given_moves[0], question)
    assert complex(x, y) == pytest.approx(at, abs=1e-6)
    assert complex(math.cos(yaw), math.sin(yaw)) == pytest.approx(heading, abs=1e-6)


def test_particles_move_as_the_robot_does() -> None:
    track = Track("robot")
    track.step(STILL, hypotheses((1.0, 2.0, math.pi / 2, 1.0)), 0.95)
    pose = track.step((1.0, 0.5, math.pi / 2), None, 0.0).pose
    assert pose is not None
    assert (pose.x, pose.y) == pytest.approx((0.5, 3.0), abs=0.1)
    assert pose.yaw is not None
    assert math.cos(pose.yaw - math.pi) > 0.99


def test_two_look_alikes_are_told_apart_by_the_way_between_two_questions() -> None:
    """Two rooms alike: one picture leaves open which, two pictures and the way between do not."""
    track = Track("robot")
    first = track.step(STILL, hypotheses((0.0, 0.0, 0.0, 0.5), (20.0, 0.0, 0.0, 0.5)), 0.8)
    assert first.confidence < 0.6
    moved = (3.0, 0.0, 0.0)
    second = track.step(moved, hypotheses((3.0, 0.0, 0.0, 0.4), (40.0, 0.0, 0.0, 0.6)), 0.8)
    assert second.pose is not None
    assert (second.pose.x, second.pose.y) == pytest.approx((3.0, 0.0), abs=0.3)
    assert second.confidence > 0.9


def test_questions_without_a_pose_do_not_weaken_the_first_that_has_one() -> None:
    """A robot that stands still has told nothing before."""
    late, prompt = Track("robot"), Track("robot")
    assert late.step(STILL, None, 0.0).pose is None
    found = hypotheses((1.0, 2.0, 0.0, 1.0))
    expected = prompt.step(STILL, found, 0.9).confidence
    assert expected > 0.8
    assert late.step(STILL, found, 0.9).confidence == pytest.approx(expected, abs=0.02)


def converged(known: float) -> tuple[Track, float]:
    """After a metre between each two of ten questions that agree."""
    track, confidence = Track("robot"), 0.0
    for step in range(10):
        moved = (float(step > 0), 0.0, 0.0)
        confidence = track.step(moved, hypotheses((step, 0.0, 0.0, 1.0)), 0.8, known).confidence
    return track, confidence


wrong_poses = st.tuples(st.floats(30.0, 90.0), st.floats(-9.0, 9.0), angles).map(
    lambda pose: hypotheses((*pose, 1.0))
)


@given(
    st.floats(0.5, 1.5),
    st.lists(
        st.tuples(st.none() | wrong_poses, st.floats(0.0, 0.1), st.floats(0.0, 0.05)),
        min_size=10,
        max_size=10,
    ),
)
@settings(max_examples=examples(20), deadline=None)
def test_things_that_the_map_does_not_have_say_soon_that_the_robot_is_elsewhere(
    way: float, asked: list[tuple[Hypotheses | None, float, float]]
) -> None:
    (track, confidence), (half, _) = converged(0.95), converged(0.95)
    assert confidence > 0.95
    for found, sure, known in asked:
        confidence = track.step((way, 0.0, 0.0), found, sure, known).confidence
        kept = half.step((way, 0.0, 0.0), found, sure, 0.5).confidence
        assert confidence < kept, "half-known things say nothing"
    assert confidence < 0.5 < track.lost
    assert half.lost < 0.4


@given(st.floats(0.5, 1.0))
@settings(max_examples=examples(10), deadline=None)
def test_things_that_the_map_has_change_nothing(known: float) -> None:
    """Seen all over the map, they do not say where in it the robot is: as with 0.5."""
    (one, first), (other, second) = converged(known), converged(0.5)
    assert first == second > 0.95
    assert one.particles.tobytes() == other.particles.tobytes()


def test_one_unknown_picture_has_little_effect() -> None:
    track, before = converged(0.95)
    after = track.step((1.0, 0.0, 0.0), hypotheses((50.0, 9.0, 1.0, 1.0)), 0.05, 0.0)
    assert 0.9 < after.confidence < before
    again = track.step((1.0, 0.0, 0.0), hypotheses((11.0, 0.0, 0.0, 1.0)), 0.8, 0.95)
    assert again.confidence > 0.97


def test_one_wrong_answer_moves_little() -> None:
    track = Track("robot")
    for step in range(4):
        track.step((1.0, 0.0, 0.0), hypotheses((step, 0.0, 0.0, 1.0)), 0.8)
    pose = track.step((1.0, 0.0, 0.0), hypotheses((30.0, 9.0, 1.0, 1.0)), 0.8).pose
    assert pose is not None
    assert (pose.x, pose.y) == pytest.approx((4.0, 0.0), abs=0.4)


def test_the_same_picture_again_counts_for_less() -> None:
    """A robot that stands still and is deceived by one look-alike does not become certain."""
    standing, driving = Track("robot"), Track("robot")
    for track, moved in ((standing, STILL), (driving, (1.0, 0.0, 0.0))):
        x = 0.0
        for _ in range(3):
            track.step(moved, hypotheses((x, 0.0, 0.0, 1.0)), 0.3)
            x += moved[0]
    assert standing.lost > 2.0 * driving.lost


def test_floors_one_above_the_other_do_not_mix() -> None:
    track = Track("robot")
    upstairs = hypotheses((1.0, 1.0, 0.0, 1.0), floor="upstairs")
    pose = track.step(STILL, upstairs, 0.9).pose
    assert pose is not None
    assert pose.floor == "upstairs"
    assert pose.document()["floor"] == "upstairs"
    for step in range(3):
        moved = (float(step > 0), 0.0, 0.0)
        downstairs = hypotheses((1.0 + step, 1.0, 0.0, 1.0), floor="downstairs")
        pose = track.step(moved, downstairs, 0.9).pose
    assert pose is not None
    assert pose.floor == "downstairs"
    assert (pose.x, pose.y) == pytest.approx((3.0, 1.0), abs=0.4)


@cache
def room_map(seed: int) -> RoomMap:
    return RoomMap(drive(Building(seed), f"m{seed}", seed, 350))


def pose_of(keyframe: Keyframe) -> Movement:
    seen = keyframe.accepted.envelope
    assert seen.map_x is not None
    assert seen.map_y is not None
    assert seen.map_yaw is not None
    return seen.map_x, seen.map_y, seen.map_yaw


def between(a: Movement, b: Movement) -> Movement:
    dx, dy, cos, sin = b[0] - a[0], b[1] - a[1], math.cos(a[2]), math.sin(a[2])
    return cos * dx + sin * dy, cos * dy - sin * dx, math.remainder(b[2] - a[2], 2.0 * math.pi)


def follow(seed: int, runs: list[list[Keyframe]]) -> tuple[list[float], list[float]]:
    """Errors of single questions and of the track; between two runs the robot was carried. The
    odometry is off by 5 %."""
    track, mapped, rng = Track("robot"), room_map(seed), np.random.default_rng(seed)
    single: list[float] = []
    tracked: list[float] = []
    for run in runs:
        last = pose_of(run[0])
        for keyframe in run:
            pose = pose_of(keyframe)
            scale = 1.0 + 0.05 * rng.normal(size=3)
            moved = between(last, pose)
            noisy = (moved[0] * scale[0], moved[1] * scale[1], moved[2] * scale[2])
            last = pose
            crops = crops_of(keyframe)[: min(2, MAX_CROPS)]
            answer = rank(crops, mapped.search(crops)) if crops else Answer((), None, 0.0)
            found = track.step(noisy, answer.hypotheses, answer.confidence, answer.known)
            single.append(error(answer.pose, pose))
            tracked.append(error(found.pose, pose))
    return single, tracked


def error(found: PoseHypothesis | None, pose: Movement) -> float:
    return 9.0 if found is None else min(math.hypot(found.x - pose[0], found.y - pose[1]), 9.0)


@pytest.mark.parametrize("seed", mostly_slow(SEEDS))
def test_a_drive_is_followed_better_than_single_questions_are_answered(seed: int) -> None:
    run = drive(Building(seed), f"q{seed}", seed + 100, 60)
    single, tracked = follow(seed, [run])
    assert np.mean(tracked) < 0.5 * np.mean(single)
    assert np.median(tracked) < 0.75 * np.median(single)
    assert np.mean(np.array(tracked[5:]) < 1.5) > 0.95


@pytest.mark.parametrize("seed", mostly_slow(SEEDS))
def test_a_kidnapped_robot_is_found_again(seed: int) -> None:
    before = drive(Building(seed), f"q{seed}", seed + 100, 30)
    after = drive(Building(seed), f"k{seed}", seed + 300, 120)
    while math.hypot(*np.subtract(pose_of(before[-1]), pose_of(after[0]))[:2]) < 4.0:
        after.pop(0)
    del after[30:]
    _, tracked = follow(seed, [before, after])
    assert max(tracked[20:30]) < 1.5
    assert tracked[30] > 1.5
    assert max(tracked[42:]) < 1.5
