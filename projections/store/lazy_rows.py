"""Sequences and mappings whose items are made from rows of tables on access."""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final, TypeVar, overload

from numpy.typing import NDArray

_T = TypeVar("_T")
_KEPT: Final = 64
_AT_ONCE: Final = 4_096
_MOST_CHUNKS: Final = 256


class Chunks(Sequence[_T]):
    """A sequence of ``count`` items; ``make(first, last)`` returns those from ``first`` to before
    ``last``.

    Indexing keeps some of the chunks made last; iterating keeps none. For many threads.
    """

    __slots__ = ("_count", "_kept", "_make")

    def __init__(self, count: int, make: Callable[[int, int], list[_T]]) -> None:
        self._count, self._make = count, make
        self._kept: dict[int, list[_T]] = {}

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> _T: ...
    @overload
    def __getitem__(self, index: slice) -> list[_T]: ...
    def __getitem__(self, index: int | slice) -> _T | list[_T]:
        if isinstance(index, slice):
            first, last, step = index.indices(self._count)
            if step != 1:
                return [self[i] for i in range(first, last, step)]
            return self._make(first, last) if first < last else []
        at = index + self._count if index < 0 else index
        if not 0 <= at < self._count:
            raise IndexError(f"{index} of {self._count}")
        chunk, within = divmod(at, _KEPT)
        made = self._kept.get(chunk)
        if made is None:
            first = chunk * _KEPT
            made = self._make(first, min(first + _KEPT, self._count))
            if len(self._kept) >= _MOST_CHUNKS:
                self._kept = {}  # all at once, as another thread may be reading it
            self._kept[chunk] = made
        return made[within]

    def __iter__(self) -> Iterator[_T]:
        for first in range(0, self._count, _AT_ONCE):
            yield from self._make(first, min(first + _AT_ONCE, self._count))


class Items(Chunks[_T]):
    """A sequence of items made from ``rows``, in order of offset. ``make`` returns the items of
    given rows, ``offsets`` the offsets of their events."""

    __slots__ = ("_made_offsets", "_offsets", "_rows")

    def __init__(
        self,
        rows: NDArray[Any],
        make: Callable[[NDArray[Any]], list[_T]],
        offsets: Callable[[NDArray[Any]], NDArray[Any]],
    ) -> None:
        super().__init__(len(rows), lambda first, last: make(rows[first:last]))
        self._rows, self._offsets = rows, offsets
        self._made_offsets: memoryview | None = None

    def before(self, end: int) -> int:
        """The number of items of events below ``end``."""
        if self._made_offsets is None:
            found: Any = self._offsets(self._rows)
            self._made_offsets = memoryview(found)
        return bisect_left(self._made_offsets, end)


class OrdinalsByName(Mapping[Any, Any]):
    """A mapping from ``count`` names to ordinals: ``find`` returns a name's ordinal or None,
    ``names`` iterates over all names."""

    def __init__(
        self, count: int, find: Callable[[Any], int | None], names: Callable[[], Iterator[Any]]
    ) -> None:
        self._count, self._find, self._names = count, lru_cache(_KEPT)(find), names

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Any]:
        return self._names()

    def __getitem__(self, name: Any) -> Any:
        found = self._find(name)
        if found is None:
            raise KeyError(name)
        return found
