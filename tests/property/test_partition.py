"""Partition comparison against scikit-learn and against counting every pair."""

from fractions import Fraction
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.map.partitions import compare_partitions

labels = st.sampled_from([None, "a", "b", "c"])
labellings = st.lists(st.tuples(labels, labels), max_size=24)


def _noise_alone(labelling: list[str | None]) -> list[str]:
    return [f"noise {i}" if label is None else label for i, label in enumerate(labelling)]


@given(labellings)
def test_the_index_is_scikit_learns(pairs: list[tuple[str | None, str | None]]) -> None:
    first, second = [a for a, _ in pairs], [b for _, b in pairs]
    from sklearn.metrics import adjusted_rand_score  # takes a second to import

    expected = adjusted_rand_score(_noise_alone(first), _noise_alone(second)) if pairs else 1.0
    assert float(compare_partitions(first, second).adjusted_rand) == pytest.approx(expected)


@given(labellings)
def test_same_means_every_pair_agrees_and_the_same_things_are_grouped(
    pairs: list[tuple[str | None, str | None]],
) -> None:
    first, second = _noise_alone([a for a, _ in pairs]), _noise_alone([b for _, b in pairs])
    agree = all(
        (first[i] == first[j]) == (second[i] == second[j])
        for i, j in combinations(range(len(pairs)), 2)
    )
    grouped = all((a is None) == (b is None) for a, b in pairs)
    found = compare_partitions([a for a, _ in pairs], [b for _, b in pairs])
    assert found.same is (agree and grouped)


@given(labellings)
def test_splits_and_joins_are_mirrors(pairs: list[tuple[str | None, str | None]]) -> None:
    first, second = [a for a, _ in pairs], [b for _, b in pairs]
    there, back = compare_partitions(first, second), compare_partitions(second, first)
    assert there.splits == back.joins
    assert there.joins == back.splits
    assert there.adjusted_rand == back.adjusted_rand


def test_a_split_and_a_join_by_hand() -> None:
    compared = compare_partitions(["a", "a", "a", "b", None], ["x", "x", "y", "y", "y"])
    assert [(s.group, [(p.group, p.count) for p in s.pieces]) for s in compared.splits] == [
        ("a", [("x", 2), ("y", 1)])
    ]
    assert [(j.group, [(p.group, p.count) for p in j.pieces]) for j in compared.joins] == [
        ("y", [(None, 1), ("a", 1), ("b", 1)])
    ]
    # pairs: 1 together in both, 3 in the first, 4 in the second, 10 in all
    assert compared.adjusted_rand == (1 - Fraction(12, 10)) / (Fraction(7, 2) - Fraction(12, 10))
