"""Deltas as rows of a history's tables, added while events are folded."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import msgspec

from eventsrc.base.crc import crc32
from eventsrc.envelope.model import Offset
from projections.fold.deltas import (
    Delta,
    EventSkipped,
    KeyframeAdded,
    KeyframePlaced,
    MapGiven,
    MergeRefused,
    ObjectClassified,
    ObjectEstimated,
    ObjectFound,
    ObjectMissing,
    ObjectMoved,
    ObjectOrdinal,
    ObjectRelocated,
    ObjectSeen,
    ObjectsMerged,
    ObservationAdded,
    PlaceChanged,
    PlaceFormed,
    PlaceNamed,
    PlaceOrdinal,
    PlacesLinked,
    PlacesMerged,
    RunSeen,
)

from .columns import STRIPE_EVENTS, Stripe, stripe_of
from .records import EdgeChange, Merge, ObjectMerge, Refusal, cause_of
from .tables import Tables, last_rows

SHORT_STRIPE_EVENTS: Final = 4_096
"""Events of a stripe that is joined with others before it is written."""
Row = Sequence[Any]
Pair = tuple[PlaceOrdinal, PlaceOrdinal]


def _keyframe(delta: KeyframeAdded) -> Row:
    at = delta.pose
    pose = (0, 0, 0, 0.0) if at is None else (1, at.x_um, at.y_um, at.yaw_rad)
    named = (delta.offset, delta.run, delta.run_id, delta.keyframe_id, delta.timestamp)
    return (*named, *pose, delta.floor)


def _observation(delta: ObservationAdded) -> Row:
    vector = delta.embedding
    return (
        delta.offset,
        delta.keyframe,
        delta.det_id,
        delta.class_name,
        delta.confidence,
        *delta.bbox,
        delta.embedding_model,
        None if vector is None else crc32(vector.data),
        delta.foreign_space,
    )


_all: Final = msgspec.structs.astuple
_ROWS: Final[Mapping[type, tuple[str, Callable[[Any], Row]]]] = {
    RunSeen: ("run", _all),
    KeyframeAdded: ("keyframe", _keyframe),
    ObservationAdded: ("observation", _observation),
    EventSkipped: (
        "skipped",
        lambda d: (d.offset, d.kind, d.run_id, d.keyframe_id, d.det_id, d.first_offset),
    ),
    MapGiven: ("map", lambda d: (d.offset,)),
    PlaceFormed: ("formed", lambda d: (d.offset, d.place_id, d.founder)),
    KeyframePlaced: ("placed", _all),
    PlaceChanged: ("changed", _all),
    PlaceNamed: ("named", _all),
    ObjectFound: ("found", lambda d: (d.offset, d.object_id, d.class_name, d.observation)),
    ObjectSeen: ("seen", _all),
    ObjectEstimated: ("estimated", _all),
    ObjectClassified: ("classified", _all),
    ObjectMissing: ("missing", _all),
    ObjectRelocated: ("relocated", _all),
    ObjectMoved: ("moved", _all),
    PlacesLinked: ("linked", _all),
}


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
        places = tables.rows_at("moved", last[last >= 0])
        self._located = {found: place for _, found, place in places}
        linked = tables.rows("linked", 0, tables.count("linked"))
        self._links: dict[Pair, int] = {(a, b): count for _, a, b, count in linked}
        self._merges = tables.count("merge")
        self._rows: defaultdict[str, list[Row]] = defaultdict(list)

    def add(self, offset: Offset, deltas: Sequence[Delta]) -> None:
        """Add the deltas of the event at ``offset``."""
        merges: list[PlacesMerged] = []
        moves: list[tuple[ObjectOrdinal, PlaceOrdinal | None]] = []
        links: list[EdgeChange] = []
        for delta in deltas:
            if (found := _ROWS.get(type(delta))) is not None:
                table, row_of = found
                self._rows[table].append(row_of(delta))
            if isinstance(delta, ObjectMoved):
                moves.append((delta.object, self._located.get(delta.object)))
                self._located[delta.object] = delta.place
            elif isinstance(delta, PlacesLinked):
                pair, after = (delta.a, delta.b), delta.shared_transitions
                links.append(EdgeChange(*pair, self._links.get(pair, 0), after))
                self._links[pair] = after
            elif isinstance(delta, PlacesMerged):
                merges.append(delta)
            elif isinstance(delta, ObjectsMerged):
                self._document("object_merge", ObjectMerge(cause_of(offset, deltas), delta))
            elif isinstance(delta, MergeRefused):
                cause = cause_of(offset, deltas)
                refusal = Refusal(cause, delta.a, delta.b, delta.bridge, delta.link, delta.apart)
                self._document("refusal", refusal)
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

    def _document(self, table: str, record: Merge | Refusal | ObjectMerge) -> None:
        text = msgspec.json.encode(record).decode()
        self._rows[table].append((record.cause.offset, text))

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
        self._document("merge", merge)
