"""What Objects are after some events: the one rule, for every reader of a history.

An Object is what the last delta of each kind about it says. Where two kinds speak of one thing:

* Its count, sums and times are those of its last sighting or of its last merge, whichever counted
  more: both give absolute values, and a count never falls.
* Its class is that of its last classification; without one, that as which it was found.
* The keyframes that should show it and do not are those of its last `ObjectMissing`; none once a
  later event has relocated it.
* It is confirmed by the first event after which `projections.map.records` says so.

`projections.map.view` applies the same deltas one by one; property tests compare the two.
"""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Final, TypeVar

import numpy as np

from eventsrc.envelope.model import Offset
from projections.fold.deltas import ObjectOrdinal
from projections.map.records import APART_S, APART_UM, EstimatedPosition, ObjectRecord

from .columns import NONE, Array
from .tables import Rows, Tables, last_rows

_CHANGES: Final[Mapping[str, str]] = {
    "seen": "object",
    "fused": "survivor",
    "relocated": "object",
    "classified": "object",
    "estimated": "object",
    "missing": "object",
    "moved": "object",
}
"""The tables that change an Object, with the column that names it."""
_VALUES: Final = ("obs_count", "sum_x_um", "sum_y_um", "first_seen", "last_seen")
_ESTIMATE: Final = ("x_um", "y_um", "var_xx_um2", "var_xy_um2", "var_yy_um2", "spots")
_OBJECT_BITS: Final = 31
_Record = TypeVar("_Record", bound=ObjectRecord)


class ObjectStates:
    """What each of ``objects`` is after the events below the number beside it in ``ends``."""

    def __init__(self, tables: Tables, objects: Rows, ends: Rows) -> None:
        self._tables, self.objects, self.ends = tables, objects, ends
        self._last: dict[str, Rows] = {}

    @classmethod
    def all_at(cls, tables: Tables, end: Offset) -> "ObjectStates":
        """All Objects found by the events below ``end``, after these."""
        count = tables.before("found", end)
        states = cls(tables, np.arange(count), np.full(count, end))
        for table, column in _CHANGES.items():  # quicker than by an index of the rows, once
            rows = tables.before(table, end)
            if rows:
                states._last[table] = last_rows(tables.column(table, column, rows), count)
        return states

    @classmethod
    def of_one(cls, tables: Tables, found: ObjectOrdinal) -> "ObjectStates":
        """An Object after each event that changed it."""
        changes = [
            tables.integers(table, "offset")[tables.group(table, column)[found]]
            for table, column in _CHANGES.items()
        ]
        ends = np.unique(np.concatenate(changes)) + 1
        return cls(tables, np.full(len(ends), found), ends)

    @classmethod
    def since(cls, tables: Tables, start: Offset) -> "ObjectStates":
        """Every Object after each event from ``start`` on that changed it, in order of the events
        and of the Objects in each."""
        changes = []
        for table, column in _CHANGES.items():
            first = tables.before(table, start)
            offsets, objects = (tables.integers(table, each)[first:] for each in ("offset", column))
            changes.append(offsets << _OBJECT_BITS | objects)
        keys = np.unique(np.concatenate(changes))
        return cls(tables, keys & (1 << _OBJECT_BITS) - 1, (keys >> _OBJECT_BITS) + 1)

    @cached_property
    def values(self) -> Mapping[str, Array]:
        """``obs_count``, ``sum_x_um``, ``sum_y_um``, ``first_seen`` and ``last_seen``."""
        seen = {name: self.of("seen", name) for name in _VALUES}
        if not self._tables.count("fused"):
            return seen
        fused = {name: self.of("fused", name) for name in _VALUES}
        is_fused = self.has("fused") & (fused["obs_count"] >= seen["obs_count"])
        return {name: np.where(is_fused, fused[name], seen[name]) for name in _VALUES}

    @cached_property
    def class_names(self) -> list[str]:
        """Their classes."""
        names = self._found("class_name")
        classified = np.flatnonzero(self.has("classified"))
        rows = self._rows("classified")[classified]
        for index, delta in zip(
            classified.tolist(), self._tables.deltas_at("classified", rows), strict=True
        ):
            names[index] = delta.class_name
        return names

    @cached_property
    def is_looked_for(self) -> Array:
        """Whether keyframes that should show them and do not count."""
        looked, moved = (self.of(table, "offset", NONE) for table in ("missing", "relocated"))
        found: Array = self.has("missing") & (moved <= looked)
        return found

    @cached_property
    def is_missing(self) -> Array:
        """Whether they are missing."""
        found: Array = self.is_looked_for & (self.of("missing", "missing") != 0)
        return found

    @cached_property
    def is_confirmed(self) -> Array:
        """Whether they are confirmed."""
        found: Array = self._tables.once("confirmed", _confirmed_at)[self.objects] < self.ends
        return found

    def has(self, table: str) -> Array:
        """Whether a row of a table says something about them."""
        found: Array = self._rows(table) != NONE
        return found

    def of(self, table: str, column: str, default: float = 0) -> Array:
        """What the last row of a table about each says, ``default`` where there is none."""
        rows = self._rows(table)
        if not self._tables.count(table):
            return np.full(len(rows), default)
        return np.where(rows == NONE, default, self._tables.column(table, column)[rows])

    def records(self, make: Callable[..., _Record]) -> list[_Record]:
        """Records, without observations and relocations; ``make`` takes what `ObjectRecord`
        does."""
        numbers = (
            self.of("moved", "place", NONE),
            self.of("missing", "misses") * self.is_looked_for,
            np.where(self.is_missing, self.of("missing", "run"), NONE),
        )
        places, misses, runs = (values.tolist() for values in numbers)
        return list(
            map(
                make,
                self.objects.tolist(),
                self._found("object_id"),
                self.class_names,
                *(self.values[name].tolist() for name in _VALUES),
                [None if place == NONE else place for place in places],
                ([] for _ in places),
                self._estimates(),
                misses,
                [None if run == NONE else run for run in runs],
                ([] for _ in places),
                self.is_confirmed.tolist(),
            )
        )

    def _estimates(self) -> list[EstimatedPosition | None]:
        found: list[EstimatedPosition | None] = [None] * len(self.objects)
        estimated = np.flatnonzero(self.has("estimated"))
        columns = [self.of("estimated", name)[estimated].tolist() for name in _ESTIMATE]
        for index, *values in zip(estimated.tolist(), *columns, strict=True):
            found[index] = EstimatedPosition(*values)
        return found

    def _found(self, column: str) -> list[str]:
        """A text of the rows that found them."""
        if not len(self.objects):
            return []
        first = int(self.objects.min())
        texts = self._tables.texts("found", column, first, int(self.objects.max()) + 1)
        return [texts[number] or "" for number in (self.objects - first).tolist()]

    def _rows(self, table: str) -> Rows:
        """The last row of a table about each; -1 for none."""
        if table not in self._last:
            self._last[table] = (
                self._tables.as_of(table, _CHANGES[table], self.objects, self.ends)
                if self._tables.count(table)
                else np.full(len(self.objects), NONE, np.int64)
            )
        return self._last[table]


def _confirmed_at(tables: Tables) -> Rows:
    """By Object the event that confirms it; 2⁶³ − 1 for one that is seen once."""
    found = np.full(tables.count("found"), np.iinfo(np.int64).max)
    if not len(found):
        return found
    seen = tables.integers("seen", "object")
    founders = tables.integers("found", "observation")
    offsets, observations = (tables.integers("seen", each) for each in ("offset", "observation"))
    rows = np.flatnonzero(_confirms(tables, founders[seen], observations))
    np.minimum.at(found, seen[rows], offsets[rows])
    parts: dict[int, list[Rows]] = {}
    merges = (
        tables.integers("fused", each).tolist() for each in ("offset", "survivor", "absorbed")
    )
    for offset, survivor, absorbed in zip(*merges, strict=True):
        own = observations[tables.group("seen", "object")[absorbed]]
        gained = np.concatenate([own, *parts.pop(absorbed, [])])
        parts.setdefault(survivor, []).append(gained)
        first = np.full(len(gained), founders[survivor])
        if found[survivor] > offset and (
            found[absorbed] <= offset or _confirms(tables, first, gained).any()
        ):
            found[survivor] = offset
    return found


def _confirms(tables: Tables, first: Rows, later: Rows) -> Array:
    """Whether each observation of ``later`` confirms an Object founded by that of ``first``."""
    keyframes = tables.integers("observation", "keyframe")
    one, other = keyframes[first], keyframes[later]
    dx, dy = (
        np.clip(
            tables.integers("keyframe", axis)[other] - tables.integers("keyframe", axis)[one],
            -APART_UM,
            APART_UM,
        )
        for axis in ("x_um", "y_um")
    )  # clipped: no square is beyond int64
    runs, times = tables.column("keyframe", "run"), tables.column("keyframe", "timestamp")
    is_measured = tables.column("observation", "measured")[later] != 0
    is_elsewhere = dx * dx + dy * dy >= APART_UM * APART_UM
    is_later = np.abs(times[other] - times[one]) > APART_S
    found: Array = is_measured | is_elsewhere | is_later | (runs[one] != runs[other])
    return found
