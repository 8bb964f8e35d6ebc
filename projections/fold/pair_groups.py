"""Groups of things that commands make one, and groups that commands keep apart.

This is transitive: if a and b are one and b and c are one, so are a and c; and a thing kept apart
from a is kept apart from all of them.
"""

from collections.abc import Container, Iterable
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

    def conflicts(self, groups: Iterable[int], others: Container[int]) -> list[tuple[int, int]]:
        """The pairs of a group of ``groups`` and one of ``others`` that are kept apart."""
        return [
            (group, other)
            for group in groups
            for other in self.against.get(group, ())
            if other in others
        ]


def without_contradictions(
    statements: Iterable[tuple[tuple[_Thing, _Thing], bool]],
) -> tuple[list[tuple[_Thing, _Thing]], list[tuple[_Thing, _Thing]]]:
    """Pairs that are one and pairs that are apart, ascending. ``statements`` come in the order in
    which they were made; true makes a pair one.

    A statement that contradicts later ones, one or several together, is left out.
    """
    roots = _Roots[_Thing]()
    enemies: dict[_Thing, set[_Thing]] = {}
    same, apart = set[tuple[_Thing, _Thing]](), set[tuple[_Thing, _Thing]]()
    for pair, is_same in reversed(list(statements)):
        a, b = map(roots.find, pair)
        if not is_same and a != b:
            enemies.setdefault(a, set()).add(b)
            enemies.setdefault(b, set()).add(a)
            apart.add(pair)
        elif is_same and b not in enemies.get(a, ()):
            same.add(pair)
            if a != b:
                roots.unite(a, b)
                for enemy in enemies.pop(b, ()):
                    enemies[enemy].remove(b)
                    enemies[enemy].add(a)
                    enemies.setdefault(a, set()).add(enemy)
    return sorted(same), sorted(apart)


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
