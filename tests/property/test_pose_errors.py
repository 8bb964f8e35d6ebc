"""Stated errors of poses against matrices, and what they do to a map."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from projections.fold.deltas import EventSkipped, Pose
from projections.fold.edited_events import _turned_covariance
from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import Settings
from projections.fold.sights import PoseError, Sights, pose_error_of
from projections.map.digest import map_digest
from tests.support.envelopes import detection, envelope
from tests.support.evidence_pictures import CAMERA, DIM, FOCAL, a_sighting
from tests.support.folds import Folded, accepted
from tests.support.thorough import examples

_ANGLE = st.floats(-7.0, 7.0)
_ROOM = (4.0, 3.0)


@st.composite
def covariances(draw: st.DrawFn) -> np.ndarray:
    """Of x, y and yaw."""
    rows = draw(st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9))
    root = np.array(rows).reshape(3, 3)
    whole = root @ root.T
    return (whole + whole.T) / 2.0


@given(covariances(), _ANGLE, st.floats(0.0, 600.0), st.booleans())
def test_the_error_across_and_along_a_ray_is_that_of_the_covariance(
    covariance: np.ndarray, yaw: float, left: float, has_depth: bool
) -> None:
    constants = EvidenceConstants()
    seen = a_sighting(0, "chair", np.ones(DIM), (left, 100.0, left + 30.0, 200.0))
    seen = seen._replace(depth=(2.0, 0.1) if has_depth else None)
    error = PoseError(covariance[0, 0], covariance[0, 1], covariance[1, 1], covariance[2, 2])
    pose = Pose(0, 0, yaw)
    (sight,) = Sights(constants).of(pose, CAMERA, [seen], error)
    (plain,) = Sights(constants).of(pose, CAMERA, [seen])
    ray = yaw + math.atan2(CAMERA.width_px / 2 - left - 15.0, FOCAL)
    along = np.array([math.cos(ray), math.sin(ray)])
    across = np.array([-along[1], along[0]])
    place = covariance[:2, :2]
    assert sight.across_m2 == pytest.approx(max(across @ place @ across, 1e-6), abs=1e-9)
    assert sight.across_per_m2 == max(plain.across_per_m2, covariance[2, 2])
    if has_depth:
        assert sight.measured is not None
        assert sight.measured[1] == pytest.approx(max(along @ place @ along, 1e-6) + 0.01)
    assert plain.across_m2 == constants.pose_m**2
    assert (
        sight._replace(
            across_m2=plain.across_m2, across_per_m2=plain.across_per_m2, measured=plain.measured
        )
        == plain
    )


@given(covariances(), _ANGLE, _ANGLE)
def test_a_corrected_pose_takes_its_error_along(
    covariance: np.ndarray, before: float, after: float
) -> None:
    nine = tuple(covariance.reshape(9).tolist())
    stated = accepted(envelope(map_yaw=before, pose_covariance=nine)).envelope
    turned = _turned_covariance(stated, after)
    turn = after - before
    matrix = np.eye(3)
    matrix[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    assert turned is not None
    expected = (matrix @ covariance @ matrix.T).reshape(9)
    np.testing.assert_allclose(turned, expected, atol=1e-9)


def test_a_pose_that_a_correction_gives_has_no_stated_error() -> None:
    lost = accepted(envelope(x=None, pose_covariance=[0.0] * 9)).envelope
    assert _turned_covariance(lost, 1.0) is None
    assert pose_error_of(lost) == PoseError(0.0, 0.0, 0.0, 0.0)
    assert pose_error_of(accepted(envelope()).envelope) is None


def drive(seed: int, sigmas: Any, *, stated: bool, thing: Any = _ROOM) -> list[dict[str, Any]]:
    """Envelopes from about a thing; each pose is off by one of ``sigmas``."""
    rng = np.random.default_rng(seed)
    vector = rng.normal(size=8)
    documents = []
    for number in range(24):
        sigma = float(rng.choice(sigmas))
        x, y = rng.uniform(0.0, 8.0), rng.uniform(0.0, 6.0)
        dx, dy = thing[0] - x, thing[1] - y
        far = math.hypot(dx, dy)
        if far < 1.0:
            continue
        yaw = math.atan2(dy, dx) + float(rng.uniform(-0.3, 0.3))
        aside = math.atan2(dy, dx) - yaw + 0.02 * float(rng.normal())
        middle = 320.0 - 320.0 * math.tan(aside)
        half = 320.0 * 0.5 / far / 2.0
        seen = detection(
            "chair",
            vector + 0.05 * rng.normal(size=8),
            bbox=[middle - half, 200.0 - half, middle + half, 200.0 + half],
        )
        off_x, off_y = sigma * rng.normal(size=2)
        more = {}
        if stated:
            more["pose_covariance"] = [sigma**2, 0, 0, 0, sigma**2, 0, 0, 0, 1e-4]
        documents.append(
            envelope(
                number,
                round(x + off_x, 6),
                round(y + off_y, 6),
                map_yaw=round(yaw, 9),
                camera={"hfov_deg": 90.0, "width_px": 640.0, "height_px": 400.0},
                detections=[seen],
                **more,
            )
        )
    return documents


EVIDENCE = Settings().with_assignments(["fusion=evidence"])


def estimates(documents: list[dict[str, Any]], chosen: Settings) -> list[tuple[float, float]]:
    folded = Folded.start(chosen).extend(documents)
    return [each.spot for each in folded.view.objects.values()]


@settings(max_examples=examples(10), deadline=None)
@given(st.integers(0, 1_000), st.floats(0.02, 0.3))
def test_equal_errors_of_all_poses_are_those_of_the_settings(seed: int, sigma: float) -> None:
    """A round error of every pose is what ``evidence.pose_m`` states for all."""
    plain = drive(seed, [sigma], stated=False)
    assume(len(plain) > 5)
    by_settings = Settings().with_assignments(["fusion=evidence", f"evidence.pose_m={sigma!r}"])
    expected = estimates(plain, by_settings)
    found = estimates(drive(seed, [sigma], stated=True), EVIDENCE)
    assert len(found) == len(expected)
    np.testing.assert_allclose(found, expected, atol=2e-6)


def test_stated_errors_make_estimates_better_where_some_poses_are_bad() -> None:
    def errors(*, stated: bool) -> list[float]:
        found = []
        for seed in range(25):
            documents = drive(seed, [0.02, 0.6], stated=stated)
            near = [math.dist(each, _ROOM) for each in estimates(documents, EVIDENCE)]
            found.append(min(near))
        return found

    without, with_errors = errors(stated=False), errors(stated=True)
    assert np.mean(with_errors) < 0.7 * np.mean(without)


def test_the_rules_of_the_page_take_no_notice_of_stated_errors() -> None:
    digests = {
        map_digest(Folded.start().extend(drive(3, [0.1], stated=stated)).view)
        for stated in (False, True)
    }
    assert len(digests) == 1


def test_a_keyframe_sent_again_with_another_error_is_a_conflict() -> None:
    one, other = ([v, 0, 0, 0, v, 0, 0, 0, v] for v in (0.01, 0.02))
    folded = Folded.start().extend(
        envelope(1, pose_covariance=nine) for nine in (one, one, other, None)
    )
    assert [each.kind for each in folded.all(EventSkipped)] == ["duplicate", "conflict", "conflict"]
