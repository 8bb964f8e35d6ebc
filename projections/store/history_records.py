"""Records of a history: causes, merges, and what happened to each place and object; and sequences
and mappings whose items are made from rows of tables on access.

Keyframes, places and objects are ordinals here, as in the deltas; ids are put in where text or JSON
is made. No record is removed: an absorbed place keeps its history and the merge that ended it.

Every record has a `Cause`: the event that made it happen, which is a keyframe. An entry of an
explanation may have a command on ``mapfold/command`` as its cause: the command changes how earlier
and later keyframes are folded, so its offset is where it was recorded, not where its effect shows.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from operator import attrgetter
from typing import Any, Final, Literal, Protocol, TypeVar, overload

from numpy.typing import NDArray

from eventsrc.envelope.model import Offset, RunId
from projections.fold import deltas as d
from projections.map.phrases import iso_time

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


CauseKind = Literal["keyframe", "command"]


@dataclass(frozen=True, slots=True)
class Cause:
    """The event at ``offset`` and what it was.

    ``time_s`` is the robot's time in seconds, for a command that of its event. ``run_id`` and
    ``keyframe_id`` name the keyframe; for a command both are None, and ``what`` is its text.
    """

    offset: Offset
    kind: CauseKind
    time_s: float | None = None
    run_id: RunId | None = None
    keyframe_id: int | None = None
    what: str | None = None

    @property
    def name(self) -> str:
        """``run:keyframe``, or the text of a command."""
        if self.kind == "keyframe":
            return f"{self.run_id}:{self.keyframe_id}"
        return self.what or f"{self.kind} at offset {self.offset}"

    @property
    def time(self) -> str | None:
        """The time as ISO 8601 in UTC."""
        return None if self.time_s is None else iso_time(self.time_s)

    @property
    def when(self) -> str:
        """The time of the event, or its name if it has no time."""
        return self.time or self.name

    @property
    def title(self) -> str:
        """Name and time, ``run:keyframe, 2026-03-24T13:00:00.000Z``."""
        return self.name if self.time is None else f"{self.name}, {self.time}"

    def document(self) -> dict[str, Any]:
        """The fields of a cause in every JSON answer."""
        return {
            "offset": self.offset,
            "time": self.time,
            "cause": self.kind,
            "run_id": self.run_id,
            "keyframe_id": self.keyframe_id,
        }


def cause_of(offset: Offset, deltas: Iterable[d.Delta]) -> Cause:
    """The cause of the deltas of one event: the keyframe it added, if it added one."""
    for delta in deltas:
        if isinstance(delta, d.KeyframeAdded):
            return Cause(offset, "keyframe", delta.timestamp, delta.run_id, delta.keyframe_id)
    return Cause(offset, "command")


@dataclass(frozen=True, slots=True)
class EdgeChange:
    """Shared transitions of two places before and after an event; 0 is no edge."""

    a: d.PlaceOrdinal
    b: d.PlaceOrdinal
    before: int
    after: int


@dataclass(frozen=True, slots=True)
class Merge:
    """A merge of places, with the objects and edges it moved.

    ``number`` counts merges from 1. Sizes are members before the merge; ``absorbed`` and
    ``absorbed_sizes`` are parallel. ``joined`` are the absorbed that came by a ``join`` command,
    ``drives`` why the others came where places are rooms.
    ``objects`` are those that the event moved out of an absorbed place. ``edges`` are all adjacency
    changes of the event that touch the places.
    """

    number: int
    cause: Cause
    bridge: d.KeyframeOrdinal
    survivor: d.PlaceOrdinal
    survivor_size: int
    absorbed: tuple[d.PlaceOrdinal, ...]
    absorbed_sizes: tuple[int, ...]
    links: tuple[d.PlaceLink, ...]
    objects: tuple[d.ObjectOrdinal, ...]
    edges: tuple[EdgeChange, ...]
    joined: tuple[d.PlaceOrdinal, ...] = ()
    drives: tuple[d.MeanDrive, ...] = ()

    @property
    def places(self) -> tuple[d.PlaceOrdinal, ...]:
        """The survivor first, then the absorbed places."""
        return (self.survivor, *self.absorbed)


@dataclass(frozen=True, slots=True)
class RefusedMerge:
    """A merge of places ``a`` and ``b`` that a command refused; ``a`` was founded first.

    ``link`` are the core points that would have joined them. ``apart`` are the keyframes that the
    command names: one in each place.
    """

    cause: Cause
    a: d.PlaceOrdinal
    b: d.PlaceOrdinal
    bridge: d.KeyframeOrdinal
    link: d.PlaceLink
    apart: tuple[d.KeyframeOrdinal, d.KeyframeOrdinal]


@dataclass(frozen=True, slots=True)
class ObjectMerge:
    """Two objects became one, by a command or by evidence. ``values`` are the survivor's since."""

    cause: Cause
    values: d.ObjectsMerged

    @property
    def offset(self) -> Offset:
        return self.cause.offset

    @property
    def survivor(self) -> d.ObjectOrdinal:
        return self.values.survivor

    @property
    def absorbed(self) -> d.ObjectOrdinal:
        return self.values.absorbed


@dataclass(slots=True)
class PlaceHistory:
    """The history of a place, from its founding on. The lists are in order of offset."""

    formed: d.PlaceFormed
    cause: Cause
    joined: list[d.KeyframePlaced] = field(default_factory=list)
    """Keyframes that joined it, without those of absorbed places."""
    changes: list[d.PlaceChanged] = field(default_factory=list)
    names: list[d.PlaceNamed] = field(default_factory=list)
    merges: list[Merge] = field(default_factory=list)
    """Merges it survived."""
    absorbed_by: Merge | None = None
    """The merge that ended it."""

    @property
    def place_id(self) -> str:
        return self.formed.place_id

    def stands(self, end: Offset) -> bool:
        """Whether it is formed and not absorbed after the events below ``end``."""
        return self.formed.offset < end and (
            self.absorbed_by is None or self.absorbed_by.cause.offset >= end
        )

    def change(self, end: Offset) -> d.PlaceChanged | None:
        """The place's size and sums after the events below ``end``."""
        return last_before(self.changes, end)

    def name(self, end: Offset) -> str | None:
        """The place's name after the events below ``end``; None without a name."""
        named = last_before(self.names, end)
        return None if named is None else named.name


@dataclass(slots=True)
class ObjectHistory:
    """The history of an object, from its first sighting on. The lists are in order of offset."""

    found: d.ObjectFound
    cause: Cause
    sightings: list[d.ObjectSeen] = field(default_factory=list)
    moves: list[d.ObjectMoved] = field(default_factory=list)
    merges: list[ObjectMerge] = field(default_factory=list)
    """Merges it survived."""
    absorbed_by: ObjectMerge | None = None
    """The merge that ended it."""
    estimates: list[d.ObjectEstimated] = field(default_factory=list)
    classes: list[d.ObjectClassified] = field(default_factory=list)
    misses: list[d.ObjectMissing] = field(default_factory=list)
    relocations: list[d.ObjectRelocated] = field(default_factory=list)

    @property
    def object_id(self) -> str:
        return self.found.object_id

    def stands(self, end: Offset) -> bool:
        """Whether it is found and not absorbed after the events below ``end``."""
        return self.found.offset < end and (
            self.absorbed_by is None or self.absorbed_by.offset >= end
        )


class _HasOffset(Protocol):
    @property
    def offset(self) -> int: ...


_Dated = TypeVar("_Dated", bound=_HasOffset)
_offset = attrgetter("offset")


def count_before(items: Sequence[_HasOffset], end: Offset) -> int:
    """The number of items, sorted by offset, that are of events below ``end``."""
    if isinstance(items, Items):
        return items.before(end)
    return bisect_left(items, end, key=_offset)


def last_before(items: Sequence[_Dated], end: Offset) -> _Dated | None:
    """The last item, sorted by offset, of the events below ``end``."""
    count = count_before(items, end)
    return items[count - 1] if count else None
