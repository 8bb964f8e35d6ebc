"""`gc_paused`: no search for cycles during a bulk fold, nor among its objects right after."""

import gc

import pytest

from projections.model.fold import gc_paused


def _is_young(thing: object) -> bool:
    return any(thing is other for n in (0, 1) for other in gc.get_objects(generation=n))


def test_nothing_is_searched_inside_and_what_was_made_is_old_afterwards() -> None:
    before = [[]]  # type: ignore[var-annotated]
    assert _is_young(before)
    with gc_paused():
        assert not gc.isenabled()
        made = [[] for _ in range(1000)]  # type: ignore[var-annotated]
        assert _is_young(made)
    assert gc.isenabled()
    assert not _is_young(made)
    assert gc.get_freeze_count() == 0  # old, yet still searched when its time comes


def test_it_ends_also_with_an_error_and_leaves_off_what_was_off() -> None:
    with pytest.raises(ZeroDivisionError), gc_paused():
        raise ZeroDivisionError
    assert gc.isenabled()
    gc.disable()
    try:
        with gc_paused():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
