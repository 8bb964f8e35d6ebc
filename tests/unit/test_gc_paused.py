"""`gc_paused`: no search for cycles during a bulk fold, nor among its objects right after."""

import gc

import pytest

from projections.map.fold import gc_paused


def _is_young(thing: object) -> bool:
    return any(thing is other for n in (0, 1) for other in gc.get_objects(generation=n))


def test_the_collector_is_off_inside_and_skips_what_was_made_afterwards() -> None:
    before = [[]]  # type: ignore[var-annotated]
    assert _is_young(before)
    with gc_paused():
        assert not gc.isenabled()
        made = [[] for _ in range(1000)]  # type: ignore[var-annotated]
        assert _is_young(made)
    assert gc.isenabled()
    assert not _is_young(made)
    assert gc.get_freeze_count() == 0  # old, yet still searched when its time comes


def test_the_collector_is_as_before_after_an_error_too() -> None:
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
