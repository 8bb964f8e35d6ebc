"""Folding a log: the shell around the pure fold that reads events and turns them into deltas."""

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from eventsrc.ingest import Rejected, ingest
from eventsrc.log import Event, LogReader
from eventsrc.system_events import is_system_key

from .deltas import Delta
from .errors import FoldError
from .reducers.semantic_map import SemanticMap
from .settings import Settings
from .view import MapView


@dataclass(frozen=True, slots=True)
class FoldedEvent:
    """What the event at ``offset`` changed; mapfold's own events change nothing."""

    offset: int
    deltas: list[Delta]


def fold_events(events: Iterable[Event], semantic_map: SemanticMap) -> Iterator[FoldedEvent]:
    """Fold events in offset order, each as it is asked for.

    Raises FoldError at an envelope that does not validate. The map has not taken it in then; its
    ``next_offset`` is that event's offset, and ``semantic_map.skip(offset)`` passes over it.
    """
    for event in events:
        yield FoldedEvent(event.offset, fold_event(event, semantic_map))


def fold_event(event: Event, semantic_map: SemanticMap) -> list[Delta]:
    """Fold one event; see `fold_events`."""
    if is_system_key(event.key):
        semantic_map.skip(event.offset)
        return []
    # The size limit belongs to the door; what is in the log was let in.
    accepted = ingest(event.payload, max_bytes=sys.maxsize)
    if isinstance(accepted, Rejected):
        raise FoldError(event.offset, accepted.reason)
    return semantic_map.fold(event.offset, accepted)


def fold_log(
    reader: LogReader,
    settings: Settings,
    until: int | None = None,
    *,
    keep_embeddings: bool = True,
) -> tuple[SemanticMap, MapView]:
    """Fold the first ``until`` events of a log, all of them for None."""
    semantic_map, view = SemanticMap(settings), MapView(settings, keep_embeddings=keep_embeddings)
    for folded in fold_events(reader.read(0, until), semantic_map):
        view.apply_event(folded.offset, folded.deltas)
    return semantic_map, view
