"""The likelihood of a crop at a pose against the same written out for one landmark and one pose."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import CameraConstants
from projections.localize.relocalize import MapConstants
from projections.localize.relocalize.appearance import DIRECTIONS, appearance_tables
from projections.localize.relocalize.camera import (
    Cameras,
    Cue,
    SightLines,
    box_rows,
    camera_values,
    half_field_rad,
    sights,
)
from projections.localize.relocalize.constants import MODEL, RankingModel
from projections.localize.relocalize.landmarks import CropGroup, Landmarks
from projections.localize.relocalize.likelihood import (
    Scene,
    log_likelihood,
    log_likelihood_of_place,
    log_likelihood_unaimed,
    terms_at,
)
from tests.support.thorough import examples

TURN = 2.0 * math.pi
seeds = st.integers(0, 2**32 - 1)


def random_group(
    rng: np.random.Generator,
    counts_of: list[int],
    camera: CameraConstants,
    *,
    boxed: bool,
    wide_m: float = 4.0,
) -> CropGroup:
    """Crops with so many landmarks each; some cues are missing, some boxes cut."""
    count = sum(counts_of)

    def cue(scale: float) -> Cue:
        variance = np.where(rng.random(count) < 0.25, math.inf, rng.uniform(0.01, 0.2, count))
        gradients = rng.normal(0, 0.3, (2, count))
        return Cue(rng.normal(0, scale, count), gradients[0], gradients[1], variance)

    places = rng.uniform(-wide_m, wide_m, (count, 2))
    root = rng.normal(0, 0.4, (count, 2, 2))
    spread = root @ root.transpose(0, 2, 1) + 0.01 * np.eye(2)
    counts = rng.integers(1, 4, count)
    marks = Landmarks(
        places,
        np.stack((spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]), axis=1),
        np.exp(rng.normal(0, 2, (count, DIRECTIONS))),
        cue(0.5),
        (cue(0.5), cue(0.5)),
        places.repeat(counts, axis=0) + rng.uniform(-4, 4, (int(counts.sum()), 2)),
        np.cumsum([0, *counts[:-1].tolist()]),
        rng.uniform(0, 1, count),
    )
    boxes: list[tuple[float, float, float, float] | None] = []
    for _ in counts_of:
        left, top = rng.uniform(0, 300), rng.uniform(0, 200)
        box = (left, top, left + rng.uniform(5, 340), top + rng.uniform(5, 200))
        if rng.random() < 0.3:
            box = (0.0, *box[1:])
        if rng.random() < 0.3:
            box = (*box[:3], camera.height_px)
        boxes.append(box if boxed else None)
    first = np.cumsum([0, *counts_of[:-1]])
    return CropGroup(
        marks,
        first,
        sights(Cameras.of([camera_values(camera)]), box_rows(boxes)),
        (True,) * len(counts_of),
    )


def one_crop(group: CropGroup, crop: int) -> CropGroup:
    """Only that crop."""
    sight = group.sight.take(np.array([crop]))
    return CropGroup(group.of_each()[crop], np.zeros(1, dtype=np.intp), sight, (True,))


def slow(group: CropGroup, pose: np.ndarray, error: float, turn: float, scene: Scene) -> float:  # type: ignore[type-arg]
    """The mixture of a group's only crop at one pose."""
    x, y, yaw = (float(v) for v in pose)
    total = 0.0
    marks, model = group.landmarks, scene.model
    ends = [*marks.starts[1:].tolist(), len(marks.seen_from)]
    for i in range(len(marks.xy)):
        points = marks.seen_from[int(marks.starts[i]) : ends[i]]
        nearest = min((px - x) ** 2 + (py - y) ** 2 for px, py in points)
        seen = math.exp(-0.5 * nearest / (model.seen_from_m**2 + error))
        total += seen * fit_of(group, i, (x, y, yaw), error, turn, scene)
    return math.log(1 - model.in_map + model.in_map * model.share * total)


def fit_of(
    crop: CropGroup,
    i: int,
    pose: tuple[float, float, float],
    error: float,
    turn: float,
    scene: Scene,
) -> float:
    marks, model, evidence = crop.landmarks, scene.model, scene.constants.evidence
    x, y, yaw = pose
    dx, dy = float(marks.xy[i, 0]) - x, float(marks.xy[i, 1]) - y
    reach = max(math.hypot(dx, dy), 0.3)
    u = np.array([dx, dy]) / reach
    xx, xy, yy = marks.spread[i]
    covariance = np.array([[xx, xy], [xy, yy]])
    pose2 = model.pose_m**2 + error
    towards = math.atan2(dy, dx)
    looked, bearing = towards, float(crop.sight.bearing[0])
    if evidence.side_by == "heading" and crop.boxed:
        looked -= bearing
    looks = float(
        np.interp(
            looked % TURN,
            np.arange(DIRECTIONS + 1) * TURN / DIRECTIONS,
            [*marks.ratios[i], marks.ratios[i][0]],
        )
    )
    half = half_field_rad(scene.camera)
    near = reach < model.twice * evidence.range_m
    if not crop.boxed:
        off = math.remainder(towards - yaw - scene.camera.yaw_rad, TURN)
        usual = (math.log(reach) - math.log(evidence.range_m)) / evidence.range_spread
        at_distance = math.exp(max(-0.5 * usual * usual, -6.0))
        return looks * (abs(off) < half) * (at_distance + model.tail * near)
    across = np.array([-u[1], u[0]])
    sigma = evidence.bearing_cut_rad if crop.sight.cut[0] else evidence.bearing_rad
    variance = (float(across @ covariance @ across) + pose2) / reach**2 + sigma**2 + turn
    off = math.remainder(towards - yaw - bearing, TURN)
    bell = math.exp(-0.5 * min(off * off / variance, 40.0)) / math.sqrt(TURN * variance)
    boxed = size_fit(crop, i, u, reach, covariance, pose2, model)
    for edge in (0, 1):
        if crop.sight.whole[edge, 0]:
            boxed += edge_fit(crop, edge, i, u, reach, covariance, pose2, model)
    in_front = near and abs(off) < half
    return looks * (bell * 2.0 * half * math.exp(boxed) + model.tail * in_front)


def log_normal(off: float, variance: float) -> float:
    return -0.5 * off * off / variance - 0.5 * math.log(TURN * variance)


def size_fit(crop, i, u, reach, covariance, pose2, model: RankingModel) -> float:  # type: ignore[no-untyped-def]
    cue, sight = crop.landmarks.size, crop.sight
    if not math.isfinite(cue.variance[i]):
        return 0.0
    g = np.array([cue.by_x[i], cue.by_y[i]]) - u / reach
    variance = float(g @ covariance @ g) + float(cue.variance[i]) + pose2 / reach**2
    taller = float(cue.mean[i]) - float(sight.log_height[0]) - math.log(reach)
    if not bool(sight.tall[0]):
        return max(-0.5 * min(taller, 0.0) ** 2 / variance, -4.0)
    ratio = log_normal(taller, variance) - log_normal(taller, variance + model.other_sizes**2)
    return min(max(ratio, -6.0), 6.0)


def edge_fit(crop, edge, i, u, reach, covariance, pose2, model: RankingModel) -> float:  # type: ignore[no-untyped-def]
    cue = crop.landmarks.edges[edge]
    if not math.isfinite(cue.variance[i]):
        return 0.0
    expected = float(cue.mean[i]) / reach
    g = (np.array([cue.by_x[i], cue.by_y[i]]) - expected * u) / reach
    variance = float(g @ covariance @ g) + model.edge_rise**2
    variance += (float(cue.variance[i]) + expected**2 * pose2) / reach**2
    off = float(crop.sight.rise[edge, 0]) - expected
    ratio = log_normal(off, variance) - log_normal(off, variance + model.other_rises**2)
    return min(max(ratio, -4.0), 4.0)


@given(
    seeds,
    st.lists(st.integers(1, 4), min_size=1, max_size=3),
    st.sampled_from(["sight", "heading"]),
    st.booleans(),
)
@settings(max_examples=examples(60), deadline=None)
def test_the_likelihood_is_that_written_out_for_each_landmark(
    seed: int, counts: list[int], side_by: str, boxed: bool
) -> None:
    rng = np.random.default_rng(seed)
    camera = CameraConstants(yaw_rad=float(rng.choice([0.0, 0.4])))
    evidence = EvidenceConstants.model_validate({"side_by": side_by})
    scene = Scene(MapConstants(evidence=evidence), camera, MODEL)
    group = random_group(rng, counts, camera, boxed=boxed)
    places, yaws = rng.uniform(-4, 4, (6, 2)), rng.uniform(-10, 10, (2, 6))
    error, turn = float(rng.uniform(0, 0.1)), float(rng.uniform(0, 0.05))
    terms = terms_at(group, places, error, scene)
    found = log_likelihood(group, terms, yaws, turn, scene)
    assert found.shape == (len(counts), 2, 6)
    for crop, of_crop in enumerate(found):
        alone = one_crop(group, crop)
        for headed, row in zip(yaws, of_crop, strict=True):
            poses = np.column_stack((places, headed))
            expected = [slow(alone, pose, error, turn, scene) for pose in poses]
            assert row.tolist() == pytest.approx(expected, abs=1e-9)
    assert found.min() >= math.log(1 - MODEL.in_map) - 1e-12


@given(seeds, st.booleans(), st.sampled_from(["sight", "heading"]))
@settings(max_examples=examples(20), deadline=None)
def test_landmarks_that_are_left_out_as_too_far_away_change_nothing(
    seed: int, boxed: bool, side_by: str
) -> None:
    """With many landmarks and positions, over some 200 m; the oracle has all of them."""
    rng = np.random.default_rng(seed)
    evidence = EvidenceConstants.model_validate({"side_by": side_by})
    scene = Scene(MapConstants(evidence=evidence), CameraConstants(), MODEL)
    group = random_group(rng, [30, 1, 25], CameraConstants(), boxed=boxed, wide_m=100.0)
    beside = group.landmarks.xy[rng.integers(0, 56, 60)] + rng.uniform(-4, 4, (60, 2))
    places = np.concatenate((beside, rng.uniform(-120, 120, (60, 2))))
    yaws = rng.uniform(-4, 4, (3, len(places)))
    error = float(rng.uniform(0, 0.1))
    some, every = (terms_at(group, places, error, scene, every=all_) for all_ in (False, True))
    assert every.looks.shape == (56, 120)
    assert 0 < some.looks.size < 0.2 * every.looks.size
    thinned = every.relevant()
    assert thinned.looks.size < 0.2 * every.looks.size
    for terms in (some, thinned):
        pairs = [
            (log_likelihood(group, each, yaws, 0.01, scene) for each in (terms, every)),
            (log_likelihood_of_place(group, each, scene) for each in (terms, every)),
            (log_likelihood_unaimed(each, scene) for each in (terms, every)),
        ]
        for found, expected in pairs:
            assert np.abs(found - expected).max() < 1e-11
    nowhere = terms_at(group, places + 1e4, error, scene)
    assert nowhere.looks.size == 0
    unexplained = log_likelihood(group, nowhere, yaws, 0.0, scene)
    assert unexplained.shape == (3, 3, 120)
    assert np.abs(unexplained - math.log(1 - MODEL.in_map)).max() < 1e-12
    index = rng.permutation(len(places))[:40]
    taken = log_likelihood(group, every.take(index), yaws[:, index], 0.0, scene)
    whole = log_likelihood(group, every, yaws, 0.0, scene)
    assert np.abs(taken - whole[:, :, index]).max() < 1e-12


def slow_table(
    likeness: list[float], side: list[float], look: float, constants: MapConstants, steps: int
) -> tuple[float, float]:
    """For one landmark and direction: which thing, which side before it is made a density. What
    speaks for a thing takes cosines of changes of side rounded to ``1 / steps``."""
    e, m = constants.evidence, MODEL
    ratios, errors = [], []
    for u, seen in zip(likeness, side, strict=True):
        cosine, usual = math.cos(look - seen), e.same_back - e.session_shift
        errors.append(u - usual - e.same_side * math.exp(e.same_kappa * (cosine - 1.0)))
        rounded = round(cosine * steps) / steps
        mean = usual + e.same_side * math.exp(e.same_kappa * (rounded - 1.0))
        same = max(-0.5 * (min(u - mean, 0.0) / e.same_spread) ** 2, -8.0)
        spread = constants.different_spread / (1.0 - constants.different)

        def density(z: float, width: float, e: EvidenceConstants = e) -> float:
            return math.exp(-0.5 * min(z * z, 200.0)) * e.same_spread / width

        different = m.look_alike * density(
            min(u - mean + m.look_alike_below, 0.0) / e.same_spread, e.same_spread
        )
        different += m.of_class * density(
            (u - e.same_class) / e.same_class_spread, e.same_class_spread
        )
        different += (1 - m.look_alike - m.of_class) * density(u / spread, spread)
        ratios.append(same - math.log(different))
    best = sorted(ratios, reverse=True)[: m.best_pairs]
    which = (sum(best) - m.missing * (m.best_pairs - len(best))) / m.best_pairs
    common = sum(errors) / len(errors)
    scatter = sum((error - common) ** 2 for error in errors) / len(errors)
    variance = max(e.same_spread, m.least_spread) ** 2
    own, number = m.own_spread * variance, min(len(errors), m.independent)
    return which, -0.5 * (scatter * number / own + common**2 / (variance - own + own / number))


def slow_row(
    likeness: list[float], side: list[float], constants: MapConstants, steps: int
) -> list[float]:
    """One landmark's table, in all directions."""
    both = [
        slow_table(likeness, side, k * TURN / DIRECTIONS, constants, steps)
        for k in range(DIRECTIONS)
    ]
    fits = [max(fit - max(f for _, f in both), -8.0) for _, fit in both]
    mean = math.log(sum(math.exp(f) for f in fits) / DIRECTIONS)
    return [
        min(which + MODEL.side_weight * (fit - mean), MODEL.most)
        for (which, _), fit in zip(both, fits, strict=True)
    ]


@given(seeds, st.lists(st.integers(1, 9), min_size=1, max_size=4))
@settings(max_examples=examples(40), deadline=None)
def test_looks_are_those_written_out_for_each_observation(seed: int, counts: list[int]) -> None:
    rng = np.random.default_rng(seed)
    constants = MapConstants(different=0.4)
    total = sum(counts)
    likeness = np.round(rng.uniform(-0.2, 0.95, total) * 128) / 128  # steps of the table
    side = rng.uniform(-math.pi, math.pi, total)
    starts = np.cumsum([0, *counts[:-1]])
    tables = appearance_tables(likeness, side, starts, constants, MODEL)
    for row, (start, count) in enumerate(zip(starts.tolist(), counts, strict=True)):
        part = slice(start, start + count)
        seen = likeness[part].tolist(), side[part].tolist()
        assert tables[row].tolist() == pytest.approx(slow_row(*seen, constants, 16), abs=1e-9)
        exact = slow_row(*seen, constants, 1 << 40)
        assert tables[row].tolist() == pytest.approx(exact, abs=0.4)
        assert float(np.mean(np.abs(tables[row] - exact))) < 0.1


@given(
    st.lists(
        st.none() | st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 4),
        min_size=1,
        max_size=4,
    )
)
def test_whatever_a_box_holds_its_sights_are_finite(boxes: list[tuple[float, ...] | None]) -> None:
    cameras = Cameras.of([camera_values(CameraConstants())])
    found: SightLines = sights(cameras, box_rows(boxes))  # type: ignore[arg-type]
    for values in (found.bearing, found.log_height, found.rise):
        assert np.isfinite(values).all()
    assert (np.abs(found.bearing) < math.pi / 2).all()
    assert not (found.whole & ~found.known).any()
