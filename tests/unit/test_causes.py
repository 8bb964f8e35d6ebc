"""A cause that is not a keyframe, as an operator's command will be, in every output."""

import pytest

from projections.fold.deltas import (
    Delta,
    KeyframeAdded,
    KeyframePlaced,
    PlaceChanged,
    PlaceFormed,
    PlaceLink,
    PlacesMerged,
    Pose,
    RunSeen,
)
from projections.fold.settings import Settings
from projections.history.explanation import explain_place, explain_same_place
from projections.history.merge_reasons import merge_document
from projections.history.rendering import explanation_text, merge_row, merge_text
from projections.store.history_records import Cause, cause_of
from tests.support.memory_history import MemoryHistory


def keyframe(number: int) -> list[Delta]:
    """A keyframe and a place of its own, far from every other."""
    return [
        KeyframeAdded(number, number, 0, "run", number, 1.0, Pose(10**7 * number, 0, 0.0)),
        PlaceFormed(number, number, f"run_p{number}", number),
        KeyframePlaced(number, number, number),
        PlaceChanged(number, number, 1, 10**7 * number, 0),
    ]


@pytest.fixture
def commanded() -> MemoryHistory:
    """Two places merged by an event without a keyframe."""
    history = MemoryHistory(Settings())
    history.apply(0, [RunSeen(0, 0, "run", 1.0), *keyframe(0)])
    history.apply(1, keyframe(1))
    merged = PlacesMerged(2, 0, (1,), 1, (PlaceLink(0, 1, 10**7),), 1, (1,))
    history.apply(2, [merged, PlaceChanged(2, 0, 2, 10**7, 0)])
    return history


def test_the_cause_is_the_command(commanded: MemoryHistory) -> None:
    (merge,) = commanded.merges
    assert merge.cause == Cause(2, "command")
    assert merge.cause.name == merge.cause.when == merge.cause.title == "command at offset 2"
    assert merge_document(commanded, merge)["cause"] == "command"
    assert merge_document(commanded, merge)["time"] is None


def test_every_text_names_the_command(commanded: MemoryHistory) -> None:
    (merge,) = commanded.merges
    explanation = explain_place(commanded, commanded.places[1], 3)
    texts = [
        merge_text(commanded, merge),
        " ".join(merge_row(commanded, merge)),
        explanation_text(explanation),
        explanation_text(explain_same_place(commanded, 0, 1, 3)),
    ]
    for text in texts:
        assert "command at offset 2" in text
        assert "None" not in text


def test_the_name_of_a_command_is_its_text() -> None:
    assert Cause(7, "command", what="kitchen was renamed").name == "kitchen was renamed"


def test_a_keyframe_is_named_by_run_and_number() -> None:
    cause = cause_of(3, [KeyframeAdded(3, 0, 0, "a:b", 12, 1774357200.25, None)])
    assert cause.title == "a:b:12, 2026-03-24T13:00:00.250Z"
