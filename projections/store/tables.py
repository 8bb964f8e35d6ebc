"""The tables of a history: stripes end to end, looked up by row, and the writer of new ones, which
turns deltas into rows while events are folded.

Numbers are read as whole columns, which are put together from the stripes when first used, texts by
the span of rows. A stripe may lie in a file (`projections.store.kept_files`), whose arrays raise
`DamagedPart` when their checksum does not match; then the stripes are made again from the log and
the look-up is repeated. The same log gives the same rows, so what was read before still holds.

Rows are never added to tables: those of a log that has grown are others. So maps that were made
from tables stay as they are, also while another thread folds on.
"""

import threading
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from typing import Any, Final, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import FIRST_OFFSET, Offset
from projections.fold import deltas as d

from .columns import NONE, ROWS, STRIPE_EVENTS, TABLES, Array, Row, Stripe, deltas_of, stripe_of
from .history_records import EdgeChange, Merge, cause_of

Rows = NDArray[np.int64]
SHORT_STRIPE_EVENTS: Final = 4_096
"""Events of a stripe that is joined with others before it is written."""
_COMPARED: Final = frozenset({d.ObjectMoved, d.PlacesLinked, d.PlacesMerged})
"""The deltas of which a merge of places says what was before."""
_T = TypeVar("_T")
_MANY: Final = 4_000
_AT_ONCE: Final = 65_536
_INDEX_BITS: Final = 32


class DamagedPart(Exception):
    """Bytes of a stripe are not those that were written; the message says where."""


class Tables:
    """Stripes in order, the first from the first event on; for many threads.

    ``again`` makes the stripes up to an offset from the log; it is called when one is damaged.
    """

    def __init__(
        self,
        stripes: Sequence[Stripe] = (),
        again: Callable[[Offset, DamagedPart], Sequence[Stripe]] | None = None,
    ) -> None:
        self.stripes = list(stripes)
        self._again = again
        self._repair = threading.Lock()
        self._columns: dict[str, Array] = {}
        self._groups: dict[str, Groups] = {}
        self._made: dict[str, Rows] = {}
        self._unreleased = 0  # rows that were read

    @property
    def end(self) -> Offset:
        """The number of events."""
        return self.stripes[-1].end if self.stripes else FIRST_OFFSET

    def count(self, table: str) -> int:
        """The number of rows of a table."""
        return sum(stripe.rows.get(table, 0) for stripe in self.stripes)

    def before(self, table: str, end: Offset) -> int:
        """The number of rows of events below ``end``."""
        return self._with_repair(lambda: self._before(table, end))

    def column(self, table: str, column: str, count: int | None = None) -> Array:
        """The first ``count`` values of a column that holds no texts, all for None."""
        return self._with_repair(lambda: self._column(table, column, count))

    def integers(self, table: str, column: str, count: int | None = None) -> Rows:
        """`column` as int64, to compute with."""
        found = self.column(table, column, count)
        return found if found.dtype == object else found.astype(np.int64, copy=False)

    def texts(self, table: str, column: str, first: int, last: int) -> list[str | None]:
        """The texts of the rows from ``first`` to before ``last``."""
        return self._with_repair(
            lambda: [
                text
                for stripe, a, b in self._spans(table, first, last)
                for text in stripe.texts(table, column, slice(a, b))
            ]
        )

    def text(self, table: str, column: str, row: int) -> str:
        """The text of a row that has one."""
        (found,) = self.texts(table, column, row, row + 1)
        return found or ""

    def codes(self, table: str, column: str, count: int | None = None) -> tuple[Array, list[str]]:
        """A column of repeated texts as numbers, and the texts that they stand for; -1 is none."""
        return self._with_repair(lambda: self._codes(table, column, count))

    def group(self, table: str, column: str) -> "Groups":
        """The rows of a table grouped by the value of a column."""
        key = f"{table}.{column}"
        if key not in self._groups:
            self._groups[key] = Groups(self.column(table, column))
        return self._groups[key]

    def once(self, name: str, make: Callable[["Tables"], Rows]) -> Rows:
        """What ``make`` makes of the tables; made when it is asked for first."""
        if name not in self._made:
            self._made[name] = make(self)
        return self._made[name]

    def as_of(self, table: str, column: str, things: Rows, ends: Rows) -> Rows:
        """For each of ``things`` the last row about it, by ``column``, of the events below its end;
        -1 for none."""
        counts = np.searchsorted(self.column(table, "offset"), ends)
        return self.group(table, column).last(things, counts)

    def deltas(self, table: str, first: int = 0, last: int | None = None) -> list[Any]:
        """The rows from ``first`` to before ``last`` as deltas; to the end for None."""
        stop = self.count(table) if last is None else last
        return deltas_of(table, self.lists(table, first, stop), range(first, stop))

    def deltas_at(self, table: str, numbers: Array) -> list[Any]:
        """These rows as deltas."""
        columns = self._with_repair(lambda: self._lists_at(table, numbers))
        return deltas_of(table, columns, numbers.tolist())

    def lists(self, table: str, first: int, last: int) -> list[list[Any]]:
        """The rows from ``first`` to before ``last`` as a list for each column, in order."""
        found = self._with_repair(lambda: self._lists(table, first, last))
        self._unreleased += last - first
        if self._unreleased >= _MANY:  # so that reading all rows does not fill memory
            self._release()
        return found

    def _before(self, table: str, end: Offset) -> int:
        count = 0
        for stripe in self.stripes:
            if stripe.end > end:
                if stripe.start < end and table in stripe.rows:
                    count += bisect_left(stripe.arrays[f"{table}.offset"], end)
                break
            count += stripe.rows.get(table, 0)
        return count

    def _column(self, table: str, column: str, count: int | None) -> Array:
        name = f"{table}.{column}"
        wanted = self.count(table) if count is None else count
        found = self._columns.get(name, _NOTHING)
        if len(found) < wanted:
            spans = self._spans(table, 0, wanted)
            parts = [stripe.arrays[name] for stripe, _, _ in spans]
            if len(parts) == 1:
                found = parts[0]
            else:
                found = np.concatenate(parts)
                self._release()
            self._columns[name] = found
        return found[:wanted]

    def _release(self) -> None:
        self._unreleased = 0
        for release in {stripe.release for stripe in self.stripes}:
            release()

    def _lists(self, table: str, first: int, last: int) -> list[list[Any]]:
        found: list[list[Any]] = [[] for _ in TABLES[table]]
        for stripe, a, b in self._spans(table, first, last):
            for column, values in zip(found, stripe.lists(table, slice(a, b)), strict=True):
                column += values
        return found

    def _lists_at(self, table: str, numbers: Array) -> list[list[Any]]:
        """The columns of these rows; of each stripe only the requested rows are read."""
        stripes = self.stripes
        bounds = np.cumsum([0, *(stripe.rows.get(table, 0) for stripe in stripes)])
        within = np.searchsorted(bounds, numbers, "right") - 1
        found: list[list[Any]] = [[] for _ in TABLES[table]]
        places: list[Array] = []
        for index in np.unique(within).tolist():
            here = np.flatnonzero(within == index)
            rows = numbers[here] - bounds[index]
            for column, values in zip(found, stripes[index].lists(table, rows), strict=True):
                column += values
            places.append(here)
            self._release()
        if len(places) < 2:
            return found
        order = np.argsort(np.concatenate(places)).tolist()
        return [[column[place] for place in order] for column in found]

    def _codes(self, table: str, column: str, count: int | None) -> tuple[Array, list[str]]:
        strings: list[str] = []
        parts: list[Array] = [_NOTHING]
        left = self.count(table) if count is None else count
        for stripe in self.stripes:
            if left > 0 and table in stripe.rows:
                codes = stripe.arrays[f"{table}.{column}"][:left].astype(np.int32)
                left -= len(codes)
                parts.append(np.where(codes == NONE, NONE, codes + np.int32(len(strings))))
                strings += stripe.strings
        return np.concatenate(parts), strings

    def _spans(self, table: str, first: int, last: int) -> Iterator[tuple[Stripe, int, int]]:
        """The stripes that have rows of a span, each with the span in its own rows."""
        stripes = self.stripes
        counts = [stripe.rows.get(table, 0) for stripe in stripes]
        for stripe, count, before in zip(
            stripes, counts, accumulate(counts, initial=0), strict=False
        ):
            a, b = max(first - before, 0), min(last - before, count)
            if a < b:
                yield stripe, a, b

    def _with_repair(self, look_up: Callable[[], _T]) -> _T:
        try:
            return look_up()
        except DamagedPart as damage:
            with self._repair:
                if self._again is not None:  # else another thread did, or there is no way to
                    self.stripes = list(self._again(self.end, damage))
                    self._again, self._columns = None, {}
            return look_up()


_NOTHING: Final[Array] = np.zeros(0, np.int8)


class Groups:
    """Indices grouped by ``values`` of 0 or more; with ``items`` these are grouped instead."""

    def __init__(self, values: Array, items: Array | None = None) -> None:
        order = np.argsort(values, kind="stable").astype(np.int32)
        self._order = order if items is None else items[order]
        counts = np.bincount(values) if len(values) else _NOTHING
        self._ends = np.concatenate([[0], np.cumsum(counts)])
        self._keys: Rows | None = None

    def __getitem__(self, value: int) -> Array:
        """The items with this value, in order."""
        if value + 1 >= len(self._ends):
            return self._order[:0]
        return self._order[self._ends[value] : self._ends[value + 1]]

    def last(self, values: Rows, limits: Rows) -> Rows:
        """For each value its last item that is below a limit; -1 for none. Items must ascend."""
        if not len(self._order):
            return np.full(len(values), NONE, np.int64)
        if self._keys is None:
            of = np.repeat(np.arange(len(self._ends) - 1), np.diff(self._ends))
            self._keys = of << _INDEX_BITS | self._order
        place = np.searchsorted(self._keys, values << _INDEX_BITS | limits) - 1
        found = self._keys[place]  # the last one where it is -1, which is of another value or none
        is_one = (place >= 0) & (found >> _INDEX_BITS == values)
        return np.where(is_one, found & (1 << _INDEX_BITS) - 1, NONE)


def last_rows(values: Array, size: int) -> Rows:
    """For each value 0 … ``size`` - 1 its last index in ``values``, -1 for none."""
    found = np.full(size, NONE, np.int64)
    for first in range(0, len(values), _AT_ONCE):  # in spans: numpy makes 64-bit copies of both
        some = values[first : first + _AT_ONCE]
        found[some] = np.arange(first, first + len(some))  # of equal indices the last one is kept
    return found


class TableWriter:
    """Makes the rows of the events after those of ``tables``, in stripes of `STRIPE_EVENTS`; in
    ``short`` ones they take less memory until they are written.

    ``end`` is the number of events whose rows are complete; an exception in the midst of an event
    leaves it before that event.
    """

    def __init__(self, tables: Tables, *, short: bool = False) -> None:
        self.end = self._start = tables.end
        self._stripe_events = SHORT_STRIPE_EVENTS if short else STRIPE_EVENTS
        self._stripes: list[Stripe] = []
        moved = tables.column("moved", "object")
        last = last_rows(moved, tables.count("found"))
        moves: list[d.ObjectMoved] = tables.deltas_at("moved", last[last >= 0])
        self._located = {each.object: each.place for each in moves}
        links: list[d.PlacesLinked] = tables.deltas("linked")
        self._links = {(each.a, each.b): each.shared_transitions for each in links}
        self._merges = tables.count("merge")
        self._rows: defaultdict[str, list[Row]] = defaultdict(list)

    def add(self, offset: Offset, deltas: Sequence[d.Delta]) -> None:
        """Add the deltas of the event at ``offset``."""
        merges: list[d.PlacesMerged] = []
        moves: list[tuple[d.ObjectOrdinal, d.PlaceOrdinal | None]] = []
        links: list[EdgeChange] = []
        for delta in deltas:
            kind = type(delta)
            if kind in ROWS:
                table, row_of = ROWS[kind]
                self._rows[table].append(row_of(delta))
            if kind not in _COMPARED:
                continue
            if isinstance(delta, d.ObjectMoved):
                moves.append((delta.object, self._located.get(delta.object)))
                self._located[delta.object] = delta.place
            elif isinstance(delta, d.PlacesLinked):
                pair, after = (delta.a, delta.b), delta.shared_transitions
                links.append(EdgeChange(*pair, self._links.get(pair, 0), after))
                self._links[pair] = after
            elif isinstance(delta, d.PlacesMerged):
                merges.append(delta)
        for merge in merges:
            self._places_merged(offset, deltas, merge, moves, links)
        end = Offset(offset + 1)
        if end - self._start == self._stripe_events:
            self._end_stripe(end)
        self.end = end

    def finish(self) -> list[Stripe]:
        """The stripes of all events that were added; called once, after the last of them."""
        if self.end > self._start:
            self._end_stripe(self.end)
        return self._stripes

    def _end_stripe(self, end: Offset) -> None:
        self._stripes.append(stripe_of(self._start, end, self._rows))
        self._start = end
        self._rows.clear()

    def _places_merged(
        self,
        offset: Offset,
        deltas: Sequence[d.Delta],
        delta: d.PlacesMerged,
        moves: list[tuple[d.ObjectOrdinal, d.PlaceOrdinal | None]],
        links: list[EdgeChange],
    ) -> None:
        places = {delta.survivor, *delta.absorbed}
        self._merges += 1
        merge = Merge(
            number=self._merges,
            cause=cause_of(offset, deltas),
            bridge=delta.bridge,
            survivor=delta.survivor,
            survivor_size=delta.survivor_count,
            absorbed=delta.absorbed,
            absorbed_sizes=delta.absorbed_counts,
            links=delta.links,
            objects=tuple(found for found, before in moves if before in delta.absorbed),
            edges=tuple(link for link in links if link.a in places or link.b in places),
            joined=delta.joined,
            drives=delta.drives,
        )
        self._rows["merge"].append((offset, msgspec.json.encode(merge).decode()))
