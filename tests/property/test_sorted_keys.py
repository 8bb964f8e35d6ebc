"""Sorted keys answer as a sorted list would, in any order of arrival and across blocks."""

import random
from bisect import bisect

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold import relations
from projections.fold.relations import SortedKeys


def _check(order: list[int]) -> None:
    keys, known = SortedKeys(), []
    for key in order:
        at = bisect(known, key)
        before = known[at - 1] % 1000 if at else None
        after = known[at] % 1000 if at < len(known) else None
        assert keys.add(key, key % 1000) == (before, after)
        known.insert(at, key)
    items = [*keys.items()]
    assert items == [(key, key % 1000) for key in known]
    again = SortedKeys(*zip(*items, strict=True)) if items else SortedKeys()
    assert again.add(10**6, 7) == ((known[-1] % 1000 if known else None), None)


@given(order=st.lists(st.integers(-(10**5), 10**5), unique=True, max_size=60))
def test_keys_added_in_any_order(order: list[int]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(relations, "_BLOCK", 4)
        _check(order)


@pytest.mark.parametrize("seed", [None, 1])
def test_keys_over_many_blocks(seed: int | None) -> None:
    order = list(range(9_000))
    if seed is not None:
        random.Random(seed).shuffle(order)
    _check(order)


def test_keys_added_in_descending_order() -> None:
    _check(list(range(9_000, 0, -1)))
