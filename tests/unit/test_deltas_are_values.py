"""Deltas are immutable values: compared by type and content, copied, pickled, printed."""

import gc
import pickle
from typing import get_args

import msgspec
import pytest

from projections.fold.deltas import (
    Delta,
    EventSkipped,
    KeyframePlaced,
    ObjectMoved,
    ObservationAdded,
    PlaceLink,
    Pose,
)

KINDS = (*get_args(Delta), PlaceLink, Pose)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_no_field_of_a_delta_can_be_changed(kind: type[msgspec.Struct]) -> None:
    fields = kind.__struct_fields__
    made = kind(*range(len(fields)))
    assert not hasattr(made, "__dict__")
    assert not gc.is_tracked(made)
    for index, field in enumerate(fields):
        assert getattr(made, field) == index
        with pytest.raises(AttributeError):
            setattr(made, field, -1)
        with pytest.raises(AttributeError):
            delattr(made, field)


def test_deltas_of_two_types_differ_even_with_equal_fields() -> None:
    assert KeyframePlaced(1, 2, 3) != ObjectMoved(1, 2, 3)
    assert KeyframePlaced(1, 2, 3) != (1, 2, 3)


def test_a_delta_compares_hashes_copies_and_pickles_by_its_fields() -> None:
    placed = KeyframePlaced(1, 2, place=3)
    assert repr(placed) == "KeyframePlaced(offset=1, keyframe=2, place=3)"
    assert placed == KeyframePlaced(1, 2, 3)
    assert hash(placed) == hash(KeyframePlaced(1, 2, 3))
    assert msgspec.structs.replace(placed, place=4) == KeyframePlaced(1, 2, 4) != placed
    assert pickle.loads(pickle.dumps(placed)) == placed


def test_an_observation_is_compared_by_identity_for_it_holds_an_array() -> None:
    one, other = (
        ObservationAdded(0, 0, 0, "r", 0, "d", "cup", 0.5, (0, 0, 1, 1), None, None, False)
        for _ in range(2)
    )
    assert one == one != other


def test_defaults_and_missing_arguments_are_as_declared() -> None:
    skipped = EventSkipped(offset=0, kind="duplicate", run_id="r", keyframe_id=1, first_offset=7)
    assert (skipped.det_id, skipped.first_offset) == (None, 7)
    with pytest.raises(TypeError, match="keyframe"):
        KeyframePlaced(1)  # type: ignore[call-arg]
