"""Things that became one: survivors of merges, groups that commands make one, and groups that they
keep apart.

What commands say is transitive: if a and b are one and b and c are one, so are a and c; and a thing
kept apart from a is kept apart from all of them.
"""

from collections.abc import Collection, Hashable, Iterable, Iterator, Set
from itertools import chain
from typing import Generic, TypeVar

from .deltas import ObjectOrdinal, PlaceOrdinal

_Ordinal = TypeVar("_Ordinal", bound=Hashable)


class Survivors(Generic[_Ordinal]):
    """Absorbed things and their survivors: union-find with path halving. `merge` is called for
    every merge, in order.

    ``absorbed_by`` maps each absorbed thing to its absorber, which may have been absorbed itself;
    `find` shortens these chains.
    """

    __slots__ = ("absorbed_by",)

    def __init__(self) -> None:
        self.absorbed_by: dict[_Ordinal, _Ordinal] = {}

    def merge(self, survivor: _Ordinal, absorbed: Iterable[_Ordinal]) -> None:
        """Record that ``survivor`` absorbed each of ``absorbed``."""
        for each in absorbed:
            self.absorbed_by[each] = survivor

    def find(self, each: _Ordinal) -> _Ordinal:
        """The survivor of ``each``; itself unless it was absorbed."""
        absorbed_by = self.absorbed_by
        while (parent := absorbed_by.get(each)) is not None:
            grandparent = absorbed_by.get(parent)
            if grandparent is None:
                return parent
            absorbed_by[each] = each = grandparent
        return each


class PlaceSurvivors(Survivors[PlaceOrdinal]):
    """Survivors of places."""

    __slots__ = ()


class ObjectSurvivors(Survivors[ObjectOrdinal]):
    """Survivors of Objects."""

    __slots__ = ()


_Thing = TypeVar("_Thing", bound=tuple[object, ...] | str)


class ApartPairs(Generic[_Thing]):
    """Pairs of things that are kept apart, given as sets of things that are divided into parts: two
    in different parts of a set are apart. Memory grows with the things in the sets, not with pairs.

    Iterated, it gives the pairs, the smaller thing first, ascending.
    """

    def __init__(self, divided: Iterable[Collection[Collection[_Thing]]] = ()) -> None:
        sets = [parts for parts in divided if len(parts) > 1]
        self.things = sorted({thing for parts in sets for part in parts for thing in part})
        """All of them, ascending; their indices stand for them in what follows."""
        rank = self._rank = {thing: number for number, thing in enumerate(self.things)}
        self.pairs: list[set[int]] = [set() for _ in self.things]
        """What each is kept apart from by sets of two."""
        self.sets: list[frozenset[int]] = []
        """The larger sets."""
        self._inside: list[list[tuple[frozenset[int], frozenset[int]]]] = [[] for _ in self.things]
        """The larger sets that each is in, and its part of them."""
        for parts in sets:
            every = frozenset([rank[thing] for part in parts for thing in part])
            if len(every) == 2:
                a, b = every
                self.pairs[a].add(b)
                self.pairs[b].add(a)
                continue
            self.sets.append(every)
            for part in parts:
                own = frozenset([rank[thing] for thing in part])
                for number in own:
                    self._inside[number].append((every, own))

    @classmethod
    def of(cls, pairs: Iterable[tuple[_Thing, _Thing]]) -> "ApartPairs[_Thing]":
        """These pairs."""
        return cls([[a], [b]] for a, b in pairs)

    def __bool__(self) -> bool:
        return bool(self.things)

    def __contains__(self, pair: tuple[_Thing, _Thing]) -> bool:
        a, b = (self._rank.get(thing, -1) for thing in pair)
        return a >= 0 and b in self.against(a)

    def __iter__(self) -> Iterator[tuple[_Thing, _Thing]]:
        for number, greater in self.greater():
            for other in greater:
                yield self.things[number], self.things[other]

    def __eq__(self, other: object) -> bool:
        """Whether these are the same pairs, however the sets are given."""
        if not isinstance(other, ApartPairs):
            return NotImplemented
        return self is other or (
            self.things == other.things
            and all(self.against(n) == other.against(n) for n in range(len(self.things)))
        )

    __hash__ = None  # type: ignore[assignment]

    def against(self, number: int) -> set[int]:
        """The indices in `things` of those that one is kept apart from."""
        inside = self._inside[number]
        return self.pairs[number].union(*(every - part for every, part in inside))

    def greater(self) -> Iterator[tuple[int, list[int]]]:
        """The index in `things` of each that is the smaller one of a pair, and those of the greater
        ones, ascending."""
        for number in range(len(self.things)):
            if found := sorted(each for each in self.against(number) if each > number):
                yield number, found

    def between(
        self, one: Iterable[_Thing], other: Iterable[_Thing]
    ) -> list[tuple[_Thing, _Thing]]:
        """The pairs of a thing of ``one`` and a thing of ``other``, ascending."""
        ends = {self._rank[thing] for thing in other if thing in self._rank}
        pairs = {
            (min(start, end), max(start, end))
            for start in (self._rank[thing] for thing in one if thing in self._rank)
            for end in self.against(start) & ends
        }
        return [(self.things[a], self.things[b]) for a, b in sorted(pairs)]


class PairGroups(Generic[_Thing]):
    """Groups of the things named in pairs that are one and in pairs that are kept apart, numbered
    from 0.

    ``group_of`` has the number of each thing. Pairs that contradict each other must have been left
    out (`without_contradictions`).
    """

    def __init__(self, same: Iterable[tuple[_Thing, _Thing]], apart: ApartPairs[_Thing]) -> None:
        same = list(same)
        roots = Survivors[_Thing]()
        for a, b in same:
            one, other = roots.find(a), roots.find(b)
            if one != other:
                roots.merge(one, (other,))
        numbers: dict[_Thing, int] = {}
        self.group_of: dict[_Thing, int] = {
            thing: numbers.setdefault(roots.find(thing), len(numbers))
            for thing in dict.fromkeys(chain(*same, apart.things))
        }
        self._against: dict[int, Set[int]] = {}
        """The groups that a group is kept apart from; its own may be among them."""
        of = [self.group_of[thing] for thing in apart.things]
        pairs: dict[int, set[int]] = {}
        for group, others in zip(of, apart.pairs, strict=True):
            if others:
                pairs.setdefault(group, set()).update(map(of.__getitem__, others))
        sets_of: dict[int, set[frozenset[int]]] = {}
        for ranks in apart.sets:
            every = frozenset(map(of.__getitem__, ranks))
            for group in every:
                sets_of.setdefault(group, set()).add(every)
        # Groups of the same sets share one value.
        joined: dict[frozenset[frozenset[int]], frozenset[int]] = {}
        self._against |= pairs
        for group, own in sets_of.items():
            key = frozenset(own)
            if key not in joined:
                joined[key] = NO_GROUPS.union(*own)
            self._against[group] = joined[key] | pairs[group] if group in pairs else joined[key]

    def conflicts(self, groups: Iterable[int], others: Set[int]) -> Iterator[tuple[int, Set[int]]]:
        """Each group of ``groups`` that is kept apart from some of ``others``, and these."""
        for group in groups:
            if against := self._against.get(group):
                found = others & against
                if group in found:
                    found = found - {group}
                if found:
                    yield group, found

    def are_apart(self, groups: Set[int], others: Set[int]) -> bool:
        """Whether any group of ``groups`` and any of ``others`` are kept apart."""
        less, more = (groups, others) if len(groups) < len(others) else (others, groups)
        return bool(self._against) and any(self.conflicts(less, more))


def without_contradictions(
    statements: Iterable[tuple[tuple[_Thing, ...], bool]],
) -> tuple[list[tuple[_Thing, _Thing]], ApartPairs[_Thing]]:
    """Pairs that are one, as they were given, ascending, and pairs that are apart. ``statements``
    come in the order in which they were made; true makes a pair one, false keeps every two of some
    things apart.

    A pair of a statement that contradicts later statements, one or several together, is left out.
    """
    roots = Survivors[_Thing]()
    # What is one is never made one with what it is kept apart from: then every root is in a set of
    # things kept apart once, and two that share such a set are apart.
    sets_of: dict[_Thing, set[int]] = {}
    parts_of: dict[tuple[_Thing, ...], list[list[_Thing]]] = {}
    same = set[tuple[_Thing, _Thing]]()
    for things, is_same in reversed(list(statements)):
        if not is_same:
            if things not in parts_of:
                parts: dict[_Thing, list[_Thing]] = {}
                for thing in things:
                    parts.setdefault(roots.find(thing), []).append(thing)
                for root in parts:
                    sets_of.setdefault(root, set()).add(len(parts_of))
                parts_of[things] = list(parts.values())
            continue
        first, second = things
        a, b = roots.find(first), roots.find(second)
        if a == b or sets_of.get(a, NO_GROUPS).isdisjoint(sets_of.get(b, NO_GROUPS)):
            same.add((first, second))
            if a != b:
                roots.merge(a, (b,))
                less, more = sorted((sets_of.pop(a, set()), sets_of.pop(b, set())), key=len)
                more |= less
                sets_of[a] = more
    return sorted(same), ApartPairs(parts_of.values())


NO_GROUPS: frozenset[int] = frozenset()
