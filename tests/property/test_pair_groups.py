"""Which of contradicting statements count, and the groups they make, by brute force."""

from itertools import product

from hypothesis import given
from hypothesis import strategies as st

from projections.fold.pair_groups import PairGroups, without_contradictions

Statement = tuple[tuple[str, str], bool]
NAMES = "abcde"
STATEMENTS = st.lists(
    st.tuples(st.tuples(st.sampled_from(NAMES), st.sampled_from(NAMES)), st.booleans()), max_size=9
)


def can_all_hold(statements: list[Statement]) -> bool:
    """Whether some partition of the names obeys all."""
    return any(
        all((part[NAMES.index(a)] == part[NAMES.index(b)]) is same for (a, b), same in statements)
        for part in product(range(len(NAMES)), repeat=len(NAMES))
    )


@given(statements=STATEMENTS)
def test_a_statement_counts_unless_later_ones_that_count_contradict_it(
    statements: list[Statement],
) -> None:
    kept: list[Statement] = []
    for statement in reversed(statements):
        if can_all_hold([*kept, statement]):
            kept.append(statement)
    same, apart = without_contradictions(statements)
    assert set(same) == {pair for pair, is_same in kept if is_same}
    assert apart == sorted({(min(pair), max(pair)) for pair, is_same in kept if not is_same})


@given(statements=STATEMENTS)
def test_groups_are_what_must_be_one_and_conflicts_what_must_not(
    statements: list[Statement],
) -> None:
    same, apart = without_contradictions(statements)
    held = [(pair, True) for pair in same] + [(pair, False) for pair in apart]
    groups = PairGroups(same, apart)
    for a in groups.group_of:
        for b in groups.group_of:
            one, other = groups.group_of[a], groups.group_of[b]
            assert (one == other) is not can_all_hold([*held, ((a, b), False)])
            conflict = groups.conflicts([one], {other: None})
            assert bool(conflict) is not can_all_hold([*held, ((a, b), True)])
            assert conflict in ([], [(one, other)])
