"""Rows of places, by both rules, under commands: batches of any size give what a rebuild does."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.commands import Join
from projections.fold.deltas import KeyframePlaced, PlaceFormed, PlacesMerged
from projections.fold.settings import Settings
from tests.property.test_rows_of_evidence import followed, rebuilt
from tests.property.test_whole_fold_corrected import World, compiled, corrected_worlds
from tests.support.envelopes import envelope
from tests.support.folds import Folded
from tests.support.memory_sink import MemoryTables
from tests.support.walks import anchor

ROOMS = {"places": "rooms", "rooms": {"cell_m": 0.25, "drive_m": 0.75}}


@given(
    world=corrected_worlds(),
    rule=st.sampled_from([{}, ROOMS]),
    size=st.integers(1, 12),
    rebuild_size=st.integers(1, 12),
)
def test_batches_of_any_size_give_the_rows_of_a_rebuild(
    world: World, rule: dict[str, Any], size: int, rebuild_size: int
) -> None:
    raw, documents, commands = world
    rules = Settings(**raw, **rule)
    corrections = compiled(commands)
    folded = Folded.start(rules, corrections=corrections).extend(documents)
    live = MemoryTables()
    followed(folded.deltas, size, live, rules, corrections)
    _, fresh, counted = rebuilt(folded.deltas, rebuild_size, rules, corrections)
    assert live.graph == fresh.graph
    assert counted["Place"] == len(folded.view.places)


@pytest.mark.parametrize("places", ["page", "rooms"])
def test_a_place_that_a_command_joins_as_it_is_formed(places: str) -> None:
    """Its rows go with it, in a batch of its own too."""
    rules = Settings(places=places, min_samples=1)
    ends = anchor("run-a", 0), anchor("run-a", 1)
    join = Join(command_id="c", places=ends, issued_by="ann@lab", reason="one")
    folded = Folded.start(rules, corrections=compiled([join]))
    folded.extend([envelope(0, 0.0), envelope(1, 50.0), envelope(2, 50.5)])
    kinds = [type(d) for d in folded.deltas[1] if type(d) in (PlaceFormed, PlacesMerged)]
    assert kinds == [PlaceFormed, PlacesMerged]
    assert [d.place for d in folded.all(KeyframePlaced)] == [0, 0, 0]
    for size in (1, 2, 3):
        live = MemoryTables()
        followed(folded.deltas, size, live, rules)
        assert live.graph == rebuilt(folded.deltas, 1, rules)[1].graph
