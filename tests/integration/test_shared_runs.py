"""The trial runs fold to what is known about them."""

import pytest

from eventsrc.envelope.ingest import Accepted, ingest
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.view import MapView
from tests.support.folds import recounted_adjacency, recounted_locations, recounted_places
from tests.support.shared_data import shared_run


def _fold(*names: str, **settings: float) -> MapView:
    chosen = Settings.model_validate(settings)
    semantic_map, view = SemanticMap(chosen), MapView(chosen)
    for payload in (line for name in names for line in shared_run(name)):
        accepted = ingest(payload)
        assert isinstance(accepted, Accepted)
        offset = semantic_map.next_offset
        view.apply_event(offset, semantic_map.fold(offset, accepted))
    return view


def test_at_the_defaults_the_house_is_one_place() -> None:
    view = _fold("house-a")
    assert len(view.keyframes) == 912
    assert len(view.observations) == 1645
    assert [place.keyframe_count for place in view.places.values()] == [912]
    assert len(view.objects) == 160


def test_with_finer_settings_the_house_has_eleven_places() -> None:
    view = _fold("house-a", eps_m=0.75, min_samples=8)
    assert len(view.places) == 11


@pytest.mark.parametrize(
    "names",
    [("house-a", "house-b", "house-c"), tuple(f"home-{i}" for i in range(1, 6))],
    ids=["house", "home"],
)
def test_real_runs_equal_their_recounts(names: tuple[str, ...]) -> None:
    view = _fold(*names, eps_m=0.75, min_samples=8)
    assert view.adjacency == recounted_adjacency(view)
    assert [found.place for found in view.objects.values()] == recounted_locations(view)
    assert {
        p.ordinal: (p.keyframe_count, p.sum_x_um, p.sum_y_um) for p in view.places.values()
    } == recounted_places(view)
