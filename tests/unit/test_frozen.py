"""What the quick way to build a frozen dataclass must not change about one."""

import pickle
from dataclasses import FrozenInstanceError, dataclass, fields, replace
from typing import get_args

import pytest

from projections.deltas import Delta, EventSkipped, KeyframePlaced


@pytest.mark.parametrize("kind", get_args(Delta), ids=lambda kind: kind.__name__)
def test_every_delta_is_a_frozen_dataclass_with_slots(kind: type) -> None:
    made = kind(*range(len(fields(kind))))  # type: ignore[arg-type]
    assert not hasattr(made, "__dict__")
    for index, field in enumerate(fields(kind)):  # type: ignore[arg-type]
        assert getattr(made, field.name) == index
        with pytest.raises(FrozenInstanceError):
            setattr(made, field.name, -1)
        with pytest.raises(FrozenInstanceError):
            delattr(made, field.name)


def test_it_prints_compares_hashes_copies_and_pickles_as_dataclasses_do() -> None:
    @dataclass(frozen=True, slots=True)
    class Witness:
        offset: int
        keyframe: int
        place: int

    placed = KeyframePlaced(1, 2, place=3)
    assert repr(placed) == repr(Witness(1, 2, 3)).replace(Witness.__qualname__, "KeyframePlaced")
    assert hash(placed) == hash(Witness(1, 2, 3))
    assert replace(placed, place=4) == KeyframePlaced(1, 2, 4) != placed
    assert pickle.loads(pickle.dumps(placed)) == placed


def test_defaults_and_missing_arguments_are_as_declared() -> None:
    skipped = EventSkipped(offset=0, kind="duplicate", run_id="r", keyframe_id=1, first_offset=7)
    assert (skipped.det_id, skipped.first_offset) == (None, 7)
    with pytest.raises(TypeError, match="'keyframe' and 'place'"):
        KeyframePlaced(1)  # type: ignore[call-arg]
