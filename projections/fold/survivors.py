"""Survivors of merged places and Objects: union-find with path halving."""

from collections.abc import Iterable
from typing import Generic, TypeVar

from .deltas import ObjectOrdinal, PlaceOrdinal

_Ordinal = TypeVar("_Ordinal", bound=int)


class Survivors(Generic[_Ordinal]):
    """Absorbed things and their survivors; `merge` is called for every merge, in order.

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
