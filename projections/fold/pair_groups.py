"""Groups of things that commands make one, and groups that commands keep apart.

This is transitive: if a and b are one and b and c are one, so are a and c; and a thing kept apart
from a is kept apart from all of them.
"""

from collections.abc import Collection, Iterable
from typing import Generic, TypeVar

_Thing = TypeVar("_Thing", bound=tuple[object, ...] | str)


class PairGroups(Generic[_Thing]):
    """Groups of the things named in two lists of pairs, numbered from 0.

    ``group_of`` has the number of each thing; ``against`` the groups that a group is kept apart
    from, where there are any. Pairs that contradict each other must have been left out
    (`without_contradictions`).
    """

    def __init__(
        self,
        same: Iterable[tuple[_Thing, _Thing]],
        apart: Iterable[tuple[_Thing, _Thing]],
    ) -> None:
        same, apart = list(same), list(apart)
        roots = _Roots[_Thing]()
        for a, b in same:
            roots.unite(a, b)
        numbers: dict[_Thing, int] = {}
        self.group_of: dict[_Thing, int] = {}
        for thing in dict.fromkeys(thing for pair in (*same, *apart) for thing in pair):
            root = roots.find(thing)
            self.group_of[thing] = numbers.setdefault(root, len(numbers))
        against: dict[int, set[int]] = {}
        for a, b in apart:
            one, other = self.group_of[a], self.group_of[b]
            against.setdefault(one, set()).add(other)
            against.setdefault(other, set()).add(one)
        self.against = {group: frozenset(others) for group, others in against.items()}

    def conflicts(self, groups: Collection[int], others: Collection[int]) -> list[tuple[int, int]]:
        """The pairs of a group of ``groups`` and one of ``others`` that are kept apart."""
        if len(groups) > len(others):
            return [(group, other) for other, group in self.conflicts(others, groups)]
        return [
            (group, other)
            for group in groups
            for other in self.against.get(group, _NONE).intersection(others)
        ]


def without_contradictions(
    statements: Iterable[tuple[tuple[_Thing, ...], bool]],
) -> tuple[list[tuple[_Thing, _Thing]], list[tuple[_Thing, _Thing]]]:
    """Pairs that are one, as they were given, and pairs that are apart, the smaller thing first;
    both ascending. ``statements`` come in the order in which they were made; true makes a pair one,
    false keeps every two of some things apart.

    A pair of a statement that contradicts later statements, one or several together, is left out.
    """
    roots = _Roots[_Thing]()
    # What is one is never made one with what it is kept apart from: then every root is in a set of
    # things kept apart once, and two that share such a set are apart.
    sets_of: dict[_Thing, set[int]] = {}
    parts_of: dict[frozenset[_Thing], list[list[_Thing]]] = {}
    same = set[tuple[_Thing, _Thing]]()
    for things, is_same in reversed(list(statements)):
        if not is_same:
            if (key := frozenset(things)) not in parts_of:
                parts: dict[_Thing, list[_Thing]] = {}
                for thing in key:
                    parts.setdefault(roots.find(thing), []).append(thing)
                for root in parts:
                    sets_of.setdefault(root, set()).add(len(parts_of))
                parts_of[key] = list(parts.values())
            continue
        first, second = things
        a, b = roots.find(first), roots.find(second)
        if a == b or sets_of.get(a, _NONE).isdisjoint(sets_of.get(b, _NONE)):
            same.add((first, second))
            if a != b:
                roots.unite(a, b)
                less, more = sorted((sets_of.pop(a, set()), sets_of.pop(b, set())), key=len)
                more |= less
                sets_of[a] = more
    return sorted(same), _pairs_between(parts_of.values())


_NONE: frozenset[int] = frozenset()


def _pairs_between(divided: Collection[list[list[_Thing]]]) -> list[tuple[_Thing, _Thing]]:
    """Every two things that are in two parts of a set of things, the smaller one first,
    ascending."""
    things = sorted({thing for parts in divided for part in parts for thing in part})
    rank = {thing: number for number, thing in enumerate(things)}
    greater: list[set[int]] = [set() for _ in things]
    for parts in divided:
        ranked = [[rank[thing] for thing in part] for part in parts]
        every = {number for part in ranked for number in part}
        for part in ranked:
            others = every.difference(part)
            for number in part:
                greater[number] |= others
    return [
        (thing, things[number])
        for at, thing in enumerate(things)
        for number in sorted(greater[at])
        if number > at
    ]


class _Roots(Generic[_Thing]):
    """Union-find: the root of ``unite(a, b)`` is that of a."""

    def __init__(self) -> None:
        self._parents: dict[_Thing, _Thing] = {}

    def find(self, thing: _Thing) -> _Thing:
        path = []
        while (parent := self._parents.get(thing)) is not None:
            path.append(thing)
            thing = parent
        for passed in path:
            self._parents[passed] = thing
        return thing

    def unite(self, a: _Thing, b: _Thing) -> None:
        one, other = self.find(a), self.find(b)
        if one != other:
            self._parents[other] = one
