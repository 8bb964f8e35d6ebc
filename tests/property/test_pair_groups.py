"""Which of contradicting statements count, and the groups they make, by brute force."""

from collections.abc import Iterator
from itertools import combinations, product

from hypothesis import given
from hypothesis import strategies as st

from projections.fold.pair_groups import ApartPairs, PairGroups, without_contradictions

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
    assert list(apart) == sorted({(min(pair), max(pair)) for pair, is_same in kept if not is_same})


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
            conflict = [*groups.conflicts([one], {other})]
            assert bool(conflict) is not can_all_hold([*held, ((a, b), True)])
            assert conflict in ([], [(one, {other})])
            assert groups.are_apart({one}, {other}) is bool(conflict)


SETS = st.lists(st.lists(st.sets(st.sampled_from(NAMES), min_size=1), min_size=1), max_size=4)


@given(sets=SETS)
def test_pairs_kept_as_divided_sets_are_those_of_two_parts(sets: list[list[set[str]]]) -> None:
    divided = [
        [part.difference(*parts[:number]) for number, part in enumerate(parts)] for parts in sets
    ]
    divided = [[part for part in parts if part] for parts in divided]
    pairs = sorted(
        {
            (min(a, b), max(a, b))
            for parts in divided
            for one, other in combinations(parts, 2)
            for a, b in product(one, other)
        }
    )
    apart = ApartPairs(divided)
    assert list(apart) == pairs
    assert apart == ApartPairs.of(pairs)
    for a, b in product(NAMES, NAMES):
        assert ((a, b) in apart) is ((min(a, b), max(a, b)) in pairs)
    some = NAMES[:3]
    assert apart.between(some, NAMES) == [p for p in pairs if not set(some).isdisjoint(p)]


class _Unlisted(dict[int, int]):
    """A dict whose keys may be looked up and not gone through."""

    def __iter__(self) -> Iterator[int]:
        raise AssertionError("it goes through the many")


def test_conflicts_go_through_the_fewer_of_a_place_with_many_anchors() -> None:
    """Else ten thousand `keep-apart` in one place cost a minute."""
    groups = PairGroups([], ApartPairs.of([("a", "b")]))
    a, b = groups.group_of["a"], groups.group_of["b"]
    many = _Unlisted({n: n for n in range(1000)}).keys()
    assert [*groups.conflicts([a], many)] == [(a, {b})]
    assert groups.are_apart({a}, many)
    assert groups.are_apart(many, {a})
