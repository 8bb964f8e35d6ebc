"""Deltas as rows of a history's tables, added while events are folded."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Final

import msgspec

from eventsrc.envelope.model import Offset
from projections.fold.deltas import (
    Delta,
    ObjectMoved,
    ObjectOrdinal,
    PlaceOrdinal,
    PlacesLinked,
    PlacesMerged,
)

from .columns import ROWS, STRIPE_EVENTS, Row, Stripe, stripe_of
from .history_records import EdgeChange, Merge, cause_of
from .tables import Tables, last_rows

SHORT_STRIPE_EVENTS: Final = 4_096
"""Events of a stripe that is joined with others before it is written."""
_COMPARED: Final = frozenset({ObjectMoved, PlacesLinked, PlacesMerged})
"""The deltas of which a merge of places says what was before."""


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
        moves: list[ObjectMoved] = tables.deltas_at("moved", last[last >= 0])
        self._located = {each.object: each.place for each in moves}
        links: list[PlacesLinked] = tables.deltas("linked")
        self._links = {(each.a, each.b): each.shared_transitions for each in links}
        self._merges = tables.count("merge")
        self._rows: defaultdict[str, list[Row]] = defaultdict(list)

    def add(self, offset: Offset, deltas: Sequence[Delta]) -> None:
        """Add the deltas of the event at ``offset``."""
        merges: list[PlacesMerged] = []
        moves: list[tuple[ObjectOrdinal, PlaceOrdinal | None]] = []
        links: list[EdgeChange] = []
        for delta in deltas:
            kind = type(delta)
            if kind in ROWS:
                table, row_of = ROWS[kind]
                self._rows[table].append(row_of(delta))
            if kind not in _COMPARED:
                continue
            if isinstance(delta, ObjectMoved):
                moves.append((delta.object, self._located.get(delta.object)))
                self._located[delta.object] = delta.place
            elif isinstance(delta, PlacesLinked):
                pair, after = (delta.a, delta.b), delta.shared_transitions
                links.append(EdgeChange(*pair, self._links.get(pair, 0), after))
                self._links[pair] = after
            elif isinstance(delta, PlacesMerged):
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
        deltas: Sequence[Delta],
        delta: PlacesMerged,
        moves: list[tuple[ObjectOrdinal, PlaceOrdinal | None]],
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
