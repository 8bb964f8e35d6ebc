"""A snapshot taken anywhere, restored and folded on, equals the fold from the start."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.adjacency import Adjacency
from projections.fold.deltas import Delta
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.snapshot import restore, snapshot, unpack
from tests.folds import Folded, fold
from tests.property.test_fold_recounts import SETTINGS, runs


def _plain(delta: Delta) -> tuple[Any, ...]:
    values = (getattr(delta, name) for name in delta.__struct_fields__)
    return type(delta), *(v.tolist() if isinstance(v, np.ndarray) else v for v in values)


def _lists(state: dict[str, Any]) -> dict[str, Any]:
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in state.items()}


@given(
    documents=runs(),
    cut=st.integers(0, 45),
    least=st.sampled_from([1, 2, 3, 5]),
    places=st.sampled_from(["page", "rooms"]),
)
def test_restore_then_fold_is_fold_from_the_start(
    documents: list[dict[str, Any]], cut: int, least: int, places: str
) -> None:
    settings = Settings(**{**SETTINGS, "min_samples": least, "places": places})
    whole = Folded.start(settings).extend(documents)
    begun = Folded.start(settings).extend(documents[:cut])
    data = snapshot(begun.map, begun.view, "log")
    again = Folded(*restore(data, begun.view.settings, "log"), [])
    again.extend(documents[cut:])
    assert [list(map(_plain, d)) for d in again.deltas] == [
        list(map(_plain, d)) for d in whole.deltas[cut:]
    ]
    assert map_digest(again.view) == map_digest(whole.view)
    assert again.view.counts() == whole.view.counts()


@given(documents=runs())
def test_a_restored_fold_gives_the_same_snapshot(documents: list[dict[str, Any]]) -> None:
    folded = fold(documents, **SETTINGS)
    data = snapshot(folded.map, folded.view, "log")
    again = restore(data, folded.view.settings, "log")
    assert _lists(unpack(data)) == _lists(unpack(snapshot(*again, "log")))


def test_a_dump_does_not_depend_on_the_order_of_edge_changes() -> None:
    adjacency = Adjacency()
    for run, keyframe_id, place in ((0, 0, 3), (0, 10, 8), (1, 0, 4), (1, 1, 9), (0, 5, 5)):
        adjacency.keyframe_placed(run, keyframe_id, place)
    dumped = adjacency.dump()
    again = Adjacency()
    again.load(dumped)
    assert _lists(again.dump()) == _lists(dumped)
    assert dumped["edges"] == [[3, 5, 1], [4, 9, 1], [5, 8, 1]]
