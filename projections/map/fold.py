"""Folding a log: reads and validates events, and passes them to the pure fold; and a log on a
timeline, for recordings.

The times of a timeline never run backwards. Those of a log may: an older run is imported later, or
a clock is set. So the time of an event there is the latest stamp of the robots' events up to it,
which keeps the order of events. mapfold's own events have the time of the one before.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from itertools import accumulate
from typing import Final, NamedTuple

from eventsrc.base.errors import LogDamaged
from eventsrc.base.machine import gc_paused
from eventsrc.envelope.ingest import Accepted, Rejected
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.log import Event, LogReader, MessageFormat, VerbatimEvent
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.deltas import Delta, PlacesMerged
from projections.fold.map_errors import FoldError
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings

from .parsing import READ_AHEAD, ParsedEvent, parsed_stretches, vectors_of
from .view import MapView

_MOST_AHEAD = 1024
"""Events read ahead where poses are corrected together; they take 20 MB."""


class FoldedEvent(NamedTuple):
    """The deltas of the event at ``offset``; of mapfold's own events only maps have any."""

    offset: Offset
    deltas: list[Delta]


def new_map(
    reader: LogReader, settings: Settings, corrections: Corrections = NO_CORRECTIONS
) -> SemanticMap:
    """A fold of this log that has folded nothing yet. Raises FoldError, LogDamaged."""
    return with_vectors(SemanticMap(settings, corrections), reader)


def with_vectors(semantic_map: SemanticMap, reader: LogReader) -> SemanticMap:
    """The map, with the vectors of its space that the log has beside those in envelopes. Raises
    FoldError, LogDamaged."""
    known = vectors_of(reader, semantic_map.settings, semantic_map.corrections)
    semantic_map.reembedded = known
    return semantic_map


def fold_events(
    events: Iterable[Event], semantic_map: SemanticMap, *, ahead: int = 1
) -> Iterator[FoldedEvent]:
    """Fold events in offset order.

    Up to ``ahead`` of them are read and validated together before the first is folded, which is
    quicker. With 1, for a live log, each is read when its deltas are asked for.

    Raises LogDamaged behind the last event before damage, and FoldError at an envelope that does
    not validate. The map is as before it then: its
    ``next_offset`` is that event's offset, and ``semantic_map.skip(offset)`` passes over it.
    Continue with another call from the offset after it; events read ahead are lost with this one.
    """
    parsed = parsed_stretches(events, ahead)
    for stretch in parsed if ahead == 1 else read_ahead(parsed, semantic_map):
        for event in stretch:
            yield FoldedEvent(event.offset, fold_parsed(event, semantic_map))


def read_ahead(
    parsed: Iterator[list[ParsedEvent]], *maps: SemanticMap
) -> Iterator[list[ParsedEvent]]:
    """The stretches of events for a fold, or for several of one pass over the log. Where many
    commands move poses of one, stretches are joined, and the poses in each are corrected together.

    What precedes damage is yielded before LogDamaged is raised.
    """
    expecting = [each.event_edits for each in maps if each.event_edits.expects]
    if not expecting:
        yield from parsed
        return
    damage: LogDamaged | None = None
    events: list[ParsedEvent] | None = None
    while damage is None and events != []:
        events = []
        try:
            for stretch in parsed:
                events += stretch
                if len(events) >= _MOST_AHEAD:
                    break
        except LogDamaged as error:
            damage = error
        coming = [
            (event.offset, event.parsed.envelope)
            for event in events
            if isinstance(event.parsed, Accepted)
        ]
        for edits in expecting:
            edits.expect(coming)
        if events:
            yield events
    if damage is not None:
        raise damage


def fold_event(event: Event, semantic_map: SemanticMap) -> list[Delta]:
    """Fold one event; see `fold_events`."""
    return next(fold_events([event], semantic_map)).deltas


def fold_parsed(event: ParsedEvent, semantic_map: SemanticMap) -> list[Delta]:
    """Fold one event of `read_ahead`. Raises FoldError for a rejected one; see `fold_events`."""
    if event.parsed is None:
        semantic_map.skip(event.offset)
        return []
    if isinstance(event.parsed, Rejected):
        raise FoldError(event.offset, event.parsed.reason)
    if isinstance(event.parsed, OccupancyMap):
        return semantic_map.use_map(event.offset, event.parsed)
    return semantic_map.fold(event.offset, event.parsed, event.units)


def fold_log(
    reader: LogReader,
    settings: Settings,
    until: Offset | None = None,
    *,
    keep_embeddings: bool = True,
    corrections: Corrections = NO_CORRECTIONS,
) -> tuple[SemanticMap, MapView]:
    """Fold the first ``until`` events of a log, all of them for None."""
    semantic_map = new_map(reader, settings, corrections)
    view = MapView(settings, keep_embeddings=keep_embeddings, corrections=corrections)
    fold_into(reader, semantic_map, view, until)
    return semantic_map, view


def fold_into(
    reader: LogReader, semantic_map: SemanticMap, view: MapView, until: Offset | None
) -> None:
    """Fold on up to ``until`` events of a log, all of them for None."""
    events = reader.read(semantic_map.next_offset, until)
    with gc_paused():
        for folded in fold_events(events, semantic_map, ahead=READ_AHEAD):
            view.apply_event(folded.offset, folded.deltas)


def format_of(event: Event) -> MessageFormat | None:
    """The format of a verbatim message, None for JSON."""
    return event.format if isinstance(event, VerbatimEvent) else None


class Moments:
    """The times of the events of a log, in ns since the Unix epoch; ``events`` are all of them."""

    def __init__(self, events: Iterable[Event]) -> None:
        topics: dict[tuple[str, MessageFormat | None], None] = {}
        stamps = []
        for event in events:
            topics[event.key, format_of(event)] = None
            is_own = not event.is_envelope
            stamps.append((None if is_own else event.stamp_ns, event.logged_ns))
        self.topics = tuple(topics)
        """Keys and formats of the events, in the order in which they appear."""
        known = [stamp for stamp, _ in stamps if stamp is not None]
        first = known[0] if known else min((logged for _, logged in stamps), default=0)
        given = (first if stamp is None else stamp for stamp, _ in stamps)
        self.times_ns = list(accumulate(given, max))
        self.backwards = sum(
            stamp is not None and stamp < time
            for (stamp, _), time in zip(stamps, self.times_ns, strict=True)
        )
        """Events whose own stamp is earlier than that of an event before them."""

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time; (0, 0) for an empty log."""
        return (self.times_ns[0], self.times_ns[-1]) if self.times_ns else (0, 0)

    def time_of(self, end: Offset) -> int:
        """The time from which the map after ``end`` events is current."""
        return self.times_ns[end - 1] if end else self.span_ns[0]

    def offset_at(self, time_ns: int) -> Offset:
        """The number of events up to a time, those at it included."""
        return Offset(bisect_right(self.times_ns, time_ns))


SCENES: Final = 500
"""The default number of scenes of a recording; each holds the whole map."""


class Step(NamedTuple):
    """A folded event: its time on a timeline (`Moments`), its deltas, and whether a scene is due
    after it."""

    event: Event
    time_ns: int
    deltas: list[Delta]
    is_scene: bool


class RecordedFold:
    """The fold of a log's first ``end`` events. A scene is due after every ``every``-th event,
    after each merge of places and at the end; by default some `SCENES` are."""

    def __init__(
        self,
        reader: LogReader,
        settings: Settings,
        end: Offset,
        *,
        corrections: Corrections = NO_CORRECTIONS,
        every: int | None = None,
        progress: Callable[[int, int], None] = lambda *_: None,
    ) -> None:
        self._reader, self._end, self._progress = reader, end, progress
        self._map = new_map(reader, settings, corrections)
        self._every = every or max(1, -(-end // SCENES))
        self.moments = Moments(reader.read(FIRST_OFFSET, end))
        self.view = MapView(settings, keep_embeddings=False, corrections=corrections)
        """The map of the events yielded so far."""
        self.merges: list[PlacesMerged] = []
        """The merges of places in the events yielded so far."""

    def __iter__(self) -> Iterator[Step]:
        """Raises FoldError at an event that cannot be folded."""
        for event in self._reader.read(FIRST_OFFSET, self._end):
            deltas = fold_event(event, self._map)
            self.view.apply_event(event.offset, deltas)
            new = [delta for delta in deltas if isinstance(delta, PlacesMerged)]
            self.merges += new
            done = self.view.next_offset
            is_scene = bool(new) or done % self._every == 0 or done == self._end
            yield Step(event, self.moments.times_ns[event.offset], deltas, is_scene)
            self._progress(done, self._end)
