"""Comparison of two partitions of the same things: adjusted Rand index, splits and joins.

A partition is a sequence of labels, one per thing; None means in no group (noise). For counting
pairs each noise thing is a group of its own: moving a keyframe from a place to noise costs
agreement, and two maps that are all noise agree.

Adjusted Rand index: Hubert and Arabie 1985, "Comparing partitions", computed as an exact fraction.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction


@dataclass(frozen=True, slots=True)
class Piece:
    """``count`` things of a group are in ``group`` of the other partition; None is noise."""

    group: str | None
    count: int


@dataclass(frozen=True, slots=True)
class Regrouping:
    """A group of one partition whose things are in several groups of the other."""

    group: str
    pieces: tuple[Piece, ...]


@dataclass(frozen=True, slots=True)
class PartitionComparison:
    """``splits`` are groups of the first that are divided in the second; ``joins`` are groups of
    the second made of several of the first. Pieces come largest first. ``grouped_once`` counts the
    things that are in a group of one partition and in none of the other."""

    things: int
    adjusted_rand: Fraction
    splits: tuple[Regrouping, ...]
    joins: tuple[Regrouping, ...]
    grouped_once: int

    @property
    def same(self) -> bool:
        """Equal up to the groups' names: the same things are grouped, in the same way."""
        regrouped = self.splits or self.joins or self.grouped_once
        return self.adjusted_rand == 1 and not regrouped


def compare_partitions(
    first: Sequence[str | None], second: Sequence[str | None]
) -> PartitionComparison:
    """Compare two labellings of the same things; both of the same length."""
    pairs = Counter(zip(first, second, strict=True))
    flipped = Counter({(b, a): n for (a, b), n in pairs.items()})
    return PartitionComparison(
        things=len(first),
        adjusted_rand=adjusted_rand(pairs),
        splits=_regroupings(pairs),
        joins=_regroupings(flipped),
        grouped_once=sum(n for (a, b), n in pairs.items() if (a is None) is not (b is None)),
    )


def adjusted_rand(pairs: Counter[tuple[str | None, str | None]]) -> Fraction:
    """The index of a contingency table: 1 when equal, about 0 when by chance, never above 1."""
    rows: Counter[str] = Counter()
    columns: Counter[str] = Counter()
    for (a, b), count in pairs.items():
        if a is not None:
            rows[a] += count
        if b is not None:
            columns[b] += count
    together = sum(_pairs(n) for (a, b), n in pairs.items() if a is not None and b is not None)
    in_first = sum(map(_pairs, rows.values()))
    in_second = sum(map(_pairs, columns.values()))
    return adjusted_rand_of_pairs(_pairs(pairs.total()), together, in_first, in_second)


def adjusted_rand_of_pairs(total: int, together: int, in_first: int, in_second: int) -> Fraction:
    """The index from numbers of pairs of things: all of them, those that share a group in both
    partitions, and those that share one in the first and in the second."""
    if in_first == in_second == together:
        return Fraction(1)
    by_chance = Fraction(in_first * in_second, total)
    return (together - by_chance) / (Fraction(in_first + in_second, 2) - by_chance)


def _pairs(count: int) -> int:
    return count * (count - 1) // 2


def _regroupings(
    pairs: Counter[tuple[str | None, str | None]],
) -> tuple[Regrouping, ...]:
    """Groups of the first label with things in two or more groups of the second, as met."""
    pieces: dict[str, list[Piece]] = {}
    for (group, other), count in pairs.items():
        if group is not None:
            pieces.setdefault(group, []).append(Piece(other, count))
    return tuple(
        Regrouping(group, tuple(sorted(found, key=lambda p: (-p.count, p.group or ""))))
        for group, found in pieces.items()
        if sum(piece.group is not None for piece in found) > 1
    )
