"""Folding a log: the shell around the pure fold that reads events and turns them into deltas."""

import gc
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import NamedTuple

from eventsrc.envelope import Offset
from eventsrc.ingest import Accepted, Rejected
from eventsrc.log import Event, LogReader
from eventsrc.system_events import is_system_key
from eventsrc.upcast import read_envelopes
from projections.deltas import Delta
from projections.errors import FoldError
from projections.exact import Neighbourhood, Units, unit_vectors
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings

from .snapshot_cache import SnapshotCache
from .view import MapView

AHEAD = 16
"""How far to read ahead in a log that is there already: 50 vectors fit a core's cache."""


WORTH_A_SNAPSHOT = 5_000
"""Events; folding fewer takes about as long as reading a snapshot of them."""


class FoldedEvent(NamedTuple):
    """What the event at ``offset`` changed; mapfold's own events change nothing."""

    offset: Offset
    deltas: list[Delta]


class ReadEvent(NamedTuple):
    """An event as the fold takes it: ``door`` is None for mapfold's own events.

    ``units`` runs parallel to the door's vectors; it is empty for what was refused.
    """

    offset: Offset
    door: Accepted | Rejected | None
    units: list[Units | None]


def fold_events(
    events: Iterable[Event], semantic_map: SemanticMap, *, ahead: int = 1
) -> Iterator[FoldedEvent]:
    """Fold events in offset order.

    Up to ``ahead`` of them are read and validated together before the first of these is folded,
    which is quicker; with 1, each is read as it is asked for, as befits a live log.

    Raises FoldError at an envelope that does not validate. The map has not taken it in then; its
    ``next_offset`` is that event's offset, and ``semantic_map.skip(offset)`` passes over it. Go on
    from the offset after it with another call; events read ahead are gone with this one.
    """
    coming = iter(events)
    while chunk := list(islice(coming, ahead)):
        for read in read_together(chunk):
            yield FoldedEvent(read.offset, fold_read(read, semantic_map))


def fold_event(event: Event, semantic_map: SemanticMap) -> list[Delta]:
    """Fold one event; see `fold_events`."""
    return next(fold_events([event], semantic_map)).deltas


def read_together(events: Sequence[Event]) -> list[ReadEvent]:
    """Read and validate events, which for sixteen or so together is quicker than one by one."""
    said = [event for event in events if not is_system_key(event.key)]
    # The size limit belongs to the door; what is in the log was let in.
    doors = read_envelopes(said, max_bytes=sys.maxsize)
    units = iter(unit_vectors([v for a in doors if isinstance(a, Accepted) for v in a.vectors]))
    coming, read = iter(doors), []
    for event in events:
        door = None if is_system_key(event.key) else next(coming)
        count = len(door.vectors) if isinstance(door, Accepted) else 0
        read.append(ReadEvent(event.offset, door, list(islice(units, count))))
    return read


def fold_read(read: ReadEvent, semantic_map: SemanticMap) -> list[Delta]:
    """Fold what `read_together` read. Raises FoldError for what was refused; see `fold_events`."""
    if read.door is None:
        semantic_map.skip(read.offset)
        return []
    if isinstance(read.door, Rejected):
        raise FoldError(read.offset, read.door.reason)
    return semantic_map.fold(read.offset, read.door, read.units)


def fold_log(
    reader: LogReader,
    settings: Settings,
    until: Offset | None = None,
    *,
    keep_embeddings: bool = True,
    neighbourhood: Neighbourhood | None = None,
) -> tuple[SemanticMap, MapView]:
    """Fold the first ``until`` events of a log, all of them for None."""
    semantic_map = SemanticMap(settings, neighbourhood)
    view = MapView(settings, keep_embeddings=keep_embeddings)
    _fold_on(reader, semantic_map, view, until)
    return semantic_map, view


def fold_log_cached(
    reader: LogReader,
    settings: Settings,
    until: Offset | None = None,
    *,
    note: Callable[[str], None] = lambda _: None,
    neighbourhood: Neighbourhood | None = None,
) -> tuple[SemanticMap, MapView]:
    """`fold_log` without embeddings, from the nearest snapshot beside the log, and leaving one.

    ``note`` is told of snapshots that could not be used or kept; the result is the same.
    """
    end = reader.next_offset if until is None else min(until, reader.next_offset)
    cache = SnapshotCache(reader.path, reader.log_id, settings, note, neighbourhood)
    semantic_map, view = cache.latest(end) or (
        SemanticMap(settings, neighbourhood),
        MapView(settings, keep_embeddings=False),
    )
    start = semantic_map.next_offset
    _fold_on(reader, semantic_map, view, end)
    if end - start >= WORTH_A_SNAPSHOT:
        cache.keep(semantic_map, view)
    return semantic_map, view


def _fold_on(
    reader: LogReader, semantic_map: SemanticMap, view: MapView, until: Offset | None
) -> None:
    events = reader.read(semantic_map.next_offset, until)
    with no_cycle_search():
        for folded in fold_events(events, semantic_map, ahead=AHEAD):
            view.apply_event(folded.offset, folded.deltas)


@contextmanager
def no_cycle_search() -> Iterator[None]:
    """Keep the garbage collector from searching for cycles: a fold makes none, and only ever adds.

    The search looks at all records again and again as a map grows, a fifth of the whole time.
    Afterwards what is there counts as old, or the next search would look at all of it as news.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.freeze()
            gc.unfreeze()
            gc.enable()
