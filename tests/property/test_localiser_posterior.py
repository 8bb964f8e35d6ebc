"""The posterior over poses against a sum over all cells and many headings, and its symmetries."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.localize.relocalize import (
    MapCandidates,
    MapConstants,
    Match,
    Question,
    QuestionView,
    rank,
)
from projections.localize.relocalize.constants import MODEL
from projections.localize.relocalize.ground import cells_near, distinct, log_prior
from projections.localize.relocalize.likelihood import Scene as Shared
from projections.localize.relocalize.likelihood import log_likelihood, terms_at
from projections.localize.relocalize.pose import CELL_M, Posterior, _sighted, locate
from projections.localize.relocalize.question import poses_at_views
from tests.support.scenes import CONSTANTS, Pose, Scene, Thing, around, movement
from tests.support.thorough import examples, rounds

HEADINGS = np.arange(72) * (math.pi / 36)


def random_scene(seed: int, *, has_estimates: bool = True) -> tuple[Scene, Pose, list[int]]:
    """A scene, a pose in it, and things that it sees: at least one."""
    rng = np.random.default_rng(seed)
    things = [
        Thing(float(x), float(y), float(rng.uniform(0.6, 1.6)))
        for x, y in rng.uniform(-3, 3, (5, 2))
    ]
    poses = [pose for thing in things for pose in around(thing, 5, 1.8, float(rng.uniform(0, 6)))]
    scene = Scene(things, poses, has_estimates=has_estimates)
    while True:
        near = poses[int(rng.integers(len(poses)))]
        x, y = near[0] + rng.normal(0, 0.2), near[1] + rng.normal(0, 0.2)
        at = (float(x), float(y), float(near[2] + rng.normal(0, 0.2)))
        shown = scene.in_view(at)
        if shown:
            return scene, at, shown[:3]


def posterior_of(question: Question, candidates: MapCandidates) -> Posterior:
    shared = Shared(candidates.constants, candidates.constants.camera, MODEL)
    found = locate(question.views, candidates.matches, shared)
    assert found is not None
    return found


def slow_posterior(question: Question, candidates: MapCandidates) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """All cells within reach and their weights, summed over 72 headings."""
    shared = Shared(candidates.constants, candidates.constants.camera, MODEL)
    (view,) = _sighted(question.views, candidates.matches, shared)
    been = distinct(np.concatenate([g.landmarks.seen_from for g in view.groups]), CELL_M / 2)
    cells, squared = cells_near(been, CELL_M, MODEL.reach_m)
    total = np.tile(log_prior(cells, squared, MODEL), (len(HEADINGS), 1))
    yaws = np.tile(HEADINGS[:, None], (1, len(cells)))
    for group in view.groups:
        terms = terms_at(group, cells, CELL_M**2 / 12, shared, every=True)
        total += log_likelihood(group, terms, yaws, 0.0, shared).sum(0)
    weights = np.exp(total - total.max()).sum(0)
    return cells, weights / weights.sum()


@given(st.integers(0, 10_000), st.booleans())
@settings(max_examples=examples(25), deadline=None)
def test_the_answer_is_about_as_good_as_that_of_a_sum_over_all_poses(
    seed: int, has_estimates: bool
) -> None:
    scene, at, shown = random_scene(seed, has_estimates=has_estimates)
    question, candidates = scene.ask([(at, shown)], noise=0.02)
    found = posterior_of(question, candidates)
    cells, weights = slow_posterior(question, candidates)
    apart = np.hypot(cells[:, 0, None] - cells[:, 0], cells[:, 1, None] - cells[:, 1])
    best = float((np.minimum(apart, 2.5) * weights[None]).sum(1).min())
    off = np.hypot(cells[:, 0] - found.x, cells[:, 1] - found.y)
    assert float((np.minimum(off, 2.5) * weights).sum()) <= best + 0.1
    mass = float(weights[off < 1.5].sum())
    assert found.features.mass == pytest.approx(mass, abs=0.25)


def test_the_mass_near_the_answer_is_on_average_that_of_a_sum_over_all_poses() -> None:
    off = []
    for seed in range(rounds(150, 30)):
        scene, at, shown = random_scene(seed, has_estimates=seed % 2 == 0)
        question, candidates = scene.ask([(at, shown)], noise=0.02)
        found = posterior_of(question, candidates)
        cells, weights = slow_posterior(question, candidates)
        near = np.hypot(cells[:, 0] - found.x, cells[:, 1] - found.y) < 1.5
        off.append(abs(found.features.mass - float(weights[near].sum())))
    assert sum(off) / len(off) < 0.035
    assert sum(each > 0.1 for each in off) <= 0.15 * len(off)


@given(st.integers(0, 10_000))
@settings(max_examples=examples(25), deadline=None)
def test_weights_are_shares_and_everything_is_finite(seed: int) -> None:
    scene, at, shown = random_scene(seed)
    found = posterior_of(*scene.ask([(at, shown)], noise=0.05))
    assert float(found.weights.sum()) == pytest.approx(1.0)
    assert (np.diff(found.weights) <= 0.0).all()
    assert np.isfinite(found.poses).all()
    assert 0.0 <= found.confidence <= 1.0
    assert 0.0 <= found.features.loss <= 2.5
    assert math.isfinite(found.spread_m)


@given(st.integers(0, 10_000), st.integers(-40, 40), st.integers(-40, 40))
@settings(max_examples=examples(15), deadline=None)
def test_a_map_moved_by_whole_cells_moves_the_answer(seed: int, across: int, up: int) -> None:
    scene, at, shown = random_scene(seed)
    dx, dy = 2 * CELL_M * across, 2 * CELL_M * up
    moved = replace(
        scene,
        things=[replace(thing, x=thing.x + dx, y=thing.y + dy) for thing in scene.things],
        poses=[(x + dx, y + dy, yaw) for x, y, yaw in scene.poses],
    )
    one = posterior_of(*scene.ask([(at, shown)]))
    other = posterior_of(*moved.ask([((at[0] + dx, at[1] + dy, at[2]), shown)]))
    assert (other.x - dx, other.y - dy) == pytest.approx((one.x, one.y), abs=0.05)


@given(st.integers(0, 10_000), st.floats(-0.2, 0.8))
@settings(max_examples=examples(15), deadline=None)
def test_only_relative_likenesses_count(seed: int, different: float) -> None:
    """Another embedding model, whose cosines of different things lie elsewhere."""
    scene, at, shown = random_scene(seed)
    scale = (1.0 - different) / (1.0 - CONSTANTS.different)
    spread = CONSTANTS.different_spread * scale
    other = replace(
        scene, constants=replace(CONSTANTS, different=different, different_spread=spread)
    )
    one = posterior_of(*scene.ask([(at, shown)], noise=0.02))
    two = posterior_of(*other.ask([(at, shown)], noise=0.02))
    assert (two.x, two.y) == pytest.approx((one.x, one.y), abs=0.02)
    assert two.features.likeness == pytest.approx(one.features.likeness, abs=1e-6)


_SMALL = st.floats(-1.0, 1.0)


@given(st.lists(st.tuples(_SMALL, _SMALL, st.floats(-3.0, 3.0)), min_size=2, max_size=5))
def test_poses_at_earlier_views_are_those_that_were_driven(path: list[Pose]) -> None:
    movements = [(0.0, 0.0, 0.0)]
    movements += [movement(a, b) for a, b in itertools.pairwise(path)]
    found = poses_at_views(np.array([path[-1]]), movements)
    for pose, expected in zip(found, path, strict=True):
        assert pose[0, :2].tolist() == pytest.approx(expected[:2], abs=1e-9)
        assert math.remainder(pose[0, 2] - expected[2], 2 * math.pi) == pytest.approx(0, abs=1e-9)


@given(st.integers(0, 10_000))
@settings(max_examples=examples(15), deadline=None)
def test_crops_in_two_views_from_one_pose_say_what_they_say_in_one(seed: int) -> None:
    scene, at, shown = random_scene(seed)
    one = posterior_of(*scene.ask([(at, shown)]))
    question, candidates = scene.ask([(at, shown)])
    (view,) = question.views
    split = Question((QuestionView(0, 0, 0, view.crops[:1]), QuestionView(0, 0, 0, view.crops[1:])))
    two = posterior_of(split, candidates)
    assert math.hypot(two.x - one.x, two.y - one.y) < 0.35


def test_turning_around_finds_the_pose_that_one_look_leaves_open() -> None:
    """Two things look alike; what stands behind the robot tells them apart."""
    things = [Thing(0, 0), Thing(20, 0), Thing(0, 4, name="sofa"), Thing(20, -4, name="shelf")]
    poses = [pose for thing in things for pose in around(thing, 8)]
    scene = Scene(things, poses)
    at, turned = (0.0, 2.0, -math.pi / 2), (0.0, 2.0, math.pi / 2)
    question, candidates = scene.ask([(at, [0]), (turned, [2])])
    # the chair's matches: its look-alike scores as high
    alike = tuple(
        m._replace(similarity=0.5 + 0.5 * 0.67) if m.object_id in ("o0", "o1") else m
        for m in candidates.matches[0]
    )
    first = MapCandidates((alike,), {}, CONSTANTS)
    alone = posterior_of(Question(question.views[:1]), first)
    both = posterior_of(question, MapCandidates((alike, candidates.matches[1]), {}, CONSTANTS))
    assert alone.features.mass < 0.75
    assert both.features.mass > 0.9
    assert math.hypot(both.x - at[0], both.y - at[1]) < 0.5
    assert both.yaw is not None
    assert abs(math.remainder(both.yaw - math.pi / 2, 2 * math.pi)) < 0.2


def test_a_robot_that_drove_between_its_views_is_where_it_is_at_the_last() -> None:
    things = [Thing(0, 0), Thing(3, 1.5), Thing(5, -1)]
    poses = [pose for thing in things for pose in around(thing, 10)]
    scene = Scene(things, poses)
    path = [(-2.0, 0.0, 0.0), (-0.9, 0.4, 0.3), (1.2, 1.2, 0.0)]
    question, candidates = scene.ask([(path[0], [0]), (path[1], [1]), (path[2], [1])])
    found = posterior_of(question, candidates)
    assert math.hypot(found.x - path[2][0], found.y - path[2][1]) < 0.5


@pytest.mark.parametrize("kind", ["no boxes", "a text", "classes"])
def test_crops_without_boxes_or_looks_are_answered_near_their_things(kind: str) -> None:
    """Near a toilet and a mirror, of which there are others elsewhere."""
    things = [
        Thing(0, 0, name="toilet"), Thing(1.5, 0.5, name="mirror"),
        Thing(12, 0, name="toilet"), Thing(-12, 5, name="mirror"),
    ]  # fmt: skip
    scene = Scene(things, [pose for thing in things for pose in around(thing, 6)])
    at = (0.7, -1.5, math.pi / 2)
    question, candidates = scene.ask([(at, [0, 1])], boxed=False)
    (view,) = question.views
    crops, rows = view.crops, candidates.matches
    if kind == "a text":
        crops = tuple(replace(crop, is_text=True) for crop in crops)
        shift = CONSTANTS.localizer.text_shift
        rows = tuple(tuple(m._replace(similarity=m.similarity - shift) for m in r) for r in rows)
    if kind == "classes":
        crops = tuple(replace(crop, vector=None) for crop in crops)
        rows = tuple(
            tuple(m._replace(similarity=1.0) for m in row if m.class_name == crop.class_name)
            for crop, row in zip(crops, rows, strict=True)
        )
    asked = Question((replace(view, crops=crops),))
    found = posterior_of(asked, replace(candidates, matches=rows))
    assert math.hypot(found.x - 0.75, found.y - 0.25) < 3.0


@given(st.integers(0, 10_000), st.booleans())
@settings(max_examples=examples(15), deadline=None)
def test_a_class_is_no_likeness(seed: int, all_classes: bool) -> None:
    """Its matches have the similarity 1, which is no evidence of how sure the pose is."""
    scene, at, shown = random_scene(seed)
    question, candidates = scene.ask([(at, [shown[0], shown[-1]])], noise=0.05)
    (view,) = question.views
    named = (True, all_classes)
    crops = tuple(
        replace(crop, vector=None) if is_named else crop
        for crop, is_named in zip(view.crops, named, strict=True)
    )
    rows = tuple(
        tuple(m._replace(similarity=1.0) for m in row) if is_named else row
        for row, is_named in zip(candidates.matches, named, strict=True)
    )
    asked = Question((replace(view, crops=crops),))
    found = posterior_of(asked, replace(candidates, matches=rows))
    if all_classes:
        assert found.features.likeness is found.features.margin is None
        assert found.confidence == pytest.approx(found.features.mass**2 / 2)
    else:
        alone = Question((replace(view, crops=view.crops[1:]),))
        expected = posterior_of(alone, replace(candidates, matches=rows[1:]))
        assert found.features.likeness == pytest.approx(expected.features.likeness)
        assert found.features.margin == expected.features.margin


@pytest.mark.parametrize(
    "box",
    [
        (0.0, 0.0, 0.0, 0.0),
        (-1e300, -1e300, 1e300, 1e300),
        (639.9, 399.9, 640.0, 400.0),
        (5.0, 5.0, 1.0, 1.0),
    ],
)
def test_a_hostile_box_leaves_the_answer_near_what_was_seen(box: tuple[float, ...]) -> None:
    """As the plain baseline, which does not read boxes."""
    scene, at, shown = random_scene(5)
    question, candidates = scene.ask([(at, shown[:1])])
    (view,) = question.views
    crops = tuple(replace(crop, bbox=box) for crop in view.crops)  # type: ignore[arg-type]
    rows = tuple(tuple(m._replace(bbox=box) for m in row) for row in candidates.matches)  # type: ignore[arg-type]
    for matches in (candidates.matches, rows):
        asked = Question((replace(view, crops=crops),))
        found = posterior_of(asked, replace(candidates, matches=matches))
        thing = scene.things[shown[0]]
        assert math.hypot(found.x - thing.x, found.y - thing.y) < 4.0


def test_matches_without_poses_leave_the_pose_open() -> None:
    match = Match(0, "d0", "run", 0.9, None, None, "cup")
    scene, at, shown = random_scene(1)
    question, _ = scene.ask([(at, shown[:1])])
    answer = rank(question, MapCandidates(((match,),), {}, MapConstants()))
    assert answer.pose is None
