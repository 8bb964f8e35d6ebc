"""Constants of a map: which cosines they are made of, and how few of them count."""

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.exact import to_float32
from projections.fold.settings import Settings
from projections.localize.relocalize import ExactIndex, MapConstants, QuestionCrop
from projections.localize.relocalize.constants import FOLLOWERS, SAMPLED, Cosines, Sample
from projections.map.view import MapView
from tests.support.folds import fold
from tests.support.logs import walk

CALIBRATED = {"camera": {"hfov_deg": 90.0, "yaw_rad": 0.5}, "evidence": {"range_m": 1.3}}


def view_of(count: int, **settings: Any) -> MapView:
    return fold(walk(count, seed=count, detections=6), **settings).view


def oracle(view: MapView, ordinals: set[int]) -> list[float]:
    """Cosines of pairs of different labels in one picture, of which ``ordinals`` has the first."""
    found = []
    for one, other in itertools.combinations(view.observations, 2):
        if (
            one.ordinal in ordinals
            and one.keyframe == other.keyframe
            and other.ordinal - one.ordinal <= FOLLOWERS
            and one.class_name != other.class_name
            and one.embedding is not None
            and other.embedding is not None
        ):
            a, b = one.embedding.astype(float), other.embedding.astype(float)
            found.append(float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b)))
    return found


def test_different_things_are_those_of_one_picture_with_different_labels() -> None:
    view = view_of(120)
    cosines = oracle(view, set(range(len(view.observations))))
    assert len(cosines) > 100
    constants = ExactIndex(view).constants
    assert constants.different == pytest.approx(np.mean(cosines), abs=0.01)
    assert constants.different_spread == pytest.approx(np.std(cosines), abs=0.05)


def test_of_many_observations_a_sample_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("projections.localize.relocalize.constants.SAMPLED", 16)
    view = view_of(60)
    last = max(o.ordinal for o in view.observations if o.embedding is not None) + 1
    assert last > 64
    sample = Sample.of(last)
    assert sample.limit <= last < 2 * sample.limit
    ordinals = set(range(sample.stride - 1, sample.limit, sample.stride))
    assert len(ordinals) == 16
    expected = oracle(view, ordinals)
    constants = MapConstants.of(
        view.settings, Cosines(len(expected), float(np.mean(expected)), float(np.std(expected)))
    )
    assert ExactIndex(view).constants == constants
    assert constants.different != MapConstants().different


@given(st.integers(0, 1 << 40))
def test_a_sample_is_bounded_and_changes_when_the_map_doubles(count: int) -> None:
    sample = Sample.of(count)
    assert sample.limit <= count
    assert sample.limit // sample.stride <= SAMPLED
    assert 2 * sample.limit >= count
    if sample.limit > SAMPLED:
        assert Sample.of(2 * sample.limit - 1) == sample


def test_constants_are_those_of_the_settings() -> None:
    constants = ExactIndex(view_of(40, **CALIBRATED)).constants
    assert (constants.camera.hfov_deg, constants.camera.yaw_rad) == (90.0, 0.5)
    assert constants.evidence.range_m == 1.3
    assert constants.localizer == Settings().localizer


def test_a_calibrated_scale_is_taken_as_it_is() -> None:
    constants = ExactIndex(view_of(40, evidence={"different": 0.7})).constants
    assert constants.different == 0.7


def test_without_pairs_they_are_a_guess() -> None:
    assert ExactIndex(view_of(0)).constants == MapConstants()
    alone = MapConstants.of(Settings(), Cosines(1, 0.1, 0.0))
    assert 0.1 < alone.different < 0.3  # a single pair outweighs the guess
    assert alone.different_spread > 0.05


def test_an_objects_estimate_is_that_of_the_fold() -> None:
    view = view_of(60, fusion="evidence")
    crops = [o for o in view.observations if o.embedding is not None][:1]
    estimates = {m.object_id: m.object_estimate for m in matches(view, crops[0]) if m.object_id}
    estimated = 0
    for found in view.objects.values():
        at = found.estimate
        if found.object_id not in estimates or at is None:
            continue
        estimate = estimates[found.object_id]
        assert estimate is not None
        assert (estimate.x, estimate.y, estimate.spots) == (at.est_x, at.est_y, at.spots)
        largest = float(
            np.linalg.eigvalsh([[estimate.xx, estimate.xy], [estimate.xy, estimate.yy]])[1]
        )
        assert largest**0.5 == pytest.approx(at.est_sigma_m, rel=1e-6)
        estimated += 1
    assert estimated > 3
    assert all(m.object_estimate is None for m in matches(view_of(60), crops[0]))


def matches(view: MapView, like: Any) -> Any:
    return ExactIndex(view).search([QuestionCrop(to_float32(like.embedding))], 200).matches[0]
