"""Folding a log: reads and validates events, and passes them to the pure fold."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from eventsrc.base.errors import LogDamaged
from eventsrc.base.machine import gc_paused
from eventsrc.envelope.ingest import Accepted, Rejected
from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.log import Event, LogReader
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.deltas import Delta
from projections.fold.map_errors import FoldError
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings

from .own_events import vectors_of
from .parsing import READ_AHEAD, ParsedEvent, parsed_stretches
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
