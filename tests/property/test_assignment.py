"""The assignment of a picture's observations to Objects, against all assignments one by one."""

import random
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold import evidence_matching
from projections.fold.deltas import ObjectOrdinal
from projections.fold.evidence_matching import Match, assign

_VALUES = st.one_of(st.sampled_from([1.0, 2.0, 3.0]), st.floats(1e-6, 30.0))
_WANTED = st.lists(st.dictionaries(st.integers(0, 5), _VALUES, max_size=5), max_size=5)


def _matches(wanted: Sequence[dict[int, float]]) -> list[list[Match]]:
    return [[(value, ObjectOrdinal(o), 0.5) for o, value in sorted(w.items())] for w in wanted]


def _largest(wanted: Sequence[Sequence[Match]], used: frozenset[int] = frozenset()) -> float:
    """The largest sum of all assignments."""
    if not wanted:
        return 0.0
    sums = [_largest(wanted[1:], used)]
    for value, ordinal, _ in wanted[0]:
        if ordinal not in used:
            sums.append(value + _largest(wanted[1:], used | {ordinal}))
    return max(sums)


def _sum(taken: Sequence[Match | None]) -> float:
    return sum(match[0] for match in taken if match is not None)


def _check_valid(wanted: Sequence[Sequence[Match]], taken: Sequence[Match | None]) -> None:
    """Each observation takes one of its own, each Object is taken once."""
    for own, match in zip(wanted, taken, strict=True):
        assert match is None or match in own
    ordinals = [match[1] for match in taken if match is not None]
    assert len(set(ordinals)) == len(ordinals)


@settings(max_examples=150)
@given(_WANTED)
def test_the_sum_of_evidence_is_the_largest_of_all_assignments(
    wanted: list[dict[int, float]],
) -> None:
    matches = _matches(wanted)
    taken = assign(matches)
    _check_valid(matches, taken)
    assert _sum(taken) == pytest.approx(_largest(matches))
    assert assign(matches) == taken


def test_an_observation_leaves_its_best_object_to_one_that_has_no_other() -> None:
    """Two identical things side by side and a heading that is wrong by half their distance: both
    want the middle one most. The best pair first would found a third Object."""
    left, right = _matches([{0: 4.0, 1: 5.0}, {1: 4.5}])
    assert assign([left, right]) == [left[0], right[0]]


@pytest.mark.parametrize("objects", [5, 60])
def test_more_observations_than_a_camera_sees_take_the_best_first(objects: int) -> None:
    chance = random.Random(objects)
    many = 2 * evidence_matching._MOST
    wanted = [{o: 0.1 + chance.random() for o in range(objects)} for _ in range(many)]
    matches = _matches(wanted)
    taken = assign(matches)
    _check_valid(matches, taken)
    assert sum(match is not None for match in taken) == min(objects, many)
    best = max((match for own in matches for match in own), key=lambda match: match[0])
    assert best in taken


def test_the_largest_picture_is_assigned_with_the_largest_sum() -> None:
    """All want the same Objects, in the same order, one more than the other."""
    size = evidence_matching._MOST
    matches = _matches([{o: (row + 1.0) * (size - o) for o in range(size)} for row in range(size)])
    taken = assign(matches)
    _check_valid(matches, taken)
    # the largest sum of products pairs the largest with the largest
    assert [match and match[1] for match in taken] == [*reversed(range(size))]
