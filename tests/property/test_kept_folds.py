"""A fold kept anywhere and folded on equals the fold from the start."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.deltas import Delta
from projections.fold.relations import Adjacency
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from tests.property.test_fold_recounts import SETTINGS, runs
from tests.support.folds import Folded, fold, resumed, state_bytes


def _plain(delta: Delta) -> tuple[Any, ...]:
    values = (getattr(delta, name) for name in delta.__struct_fields__)
    values = (v.digest() if isinstance(v, OccupancyMap) else v for v in values)
    return type(delta), *(v.tolist() if isinstance(v, np.ndarray) else v for v in values)


def _lists(state: dict[str, Any]) -> dict[str, Any]:
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in state.items()}


@given(
    documents=runs(),
    cut=st.integers(0, 45),
    least=st.sampled_from([1, 2, 3, 5]),
    places=st.sampled_from(["page", "rooms"]),
)
def test_resume_then_fold_is_fold_from_the_start(
    documents: list[dict[str, Any]], cut: int, least: int, places: str
) -> None:
    settings = Settings(**{**SETTINGS, "min_samples": least, "places": places})
    whole = Folded.start(settings).extend(documents)
    begun = Folded.start(settings).extend(documents[:cut])
    again = resumed(begun)
    again.extend(documents[cut:])
    assert [list(map(_plain, d)) for d in again.deltas] == [
        list(map(_plain, d)) for d in whole.deltas[cut:]
    ]
    assert map_digest(again.view) == map_digest(whole.view)
    assert again.view.counts() == whole.view.counts()


@given(documents=runs())
def test_a_resumed_fold_has_the_same_state(documents: list[dict[str, Any]]) -> None:
    folded = fold(documents, **SETTINGS)
    assert state_bytes(resumed(folded)) == state_bytes(folded)


def test_a_dump_does_not_depend_on_the_order_of_edge_changes() -> None:
    adjacency = Adjacency()
    for run, keyframe_id, place in ((0, 0, 3), (0, 10, 8), (1, 0, 4), (1, 1, 9), (0, 5, 5)):
        adjacency.keyframe_placed(run, keyframe_id, place)
    dumped = adjacency.dump()
    again = Adjacency()
    again.load(dumped)
    assert _lists(again.dump()) == _lists(dumped)
    assert dumped["edges"] == [[3, 5, 1], [4, 9, 1], [5, 8, 1]]
