"""Folds a log into the tables of a history, from the end of the cached history on.

Long folds are cached beside the log, so that the next process folds only later events.
"""

from collections.abc import Callable
from typing import Final, TypeAlias

from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.errors import FoldError
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.fold import READ_AHEAD, fold_events, gc_paused, parse_events
from projections.map.space_vectors import new_map

from .column_rows import TableWriter
from .columns import Stripe
from .tables import DamagedPart, Tables
from .timeline_cache import TimelineCache

Progress: TypeAlias = Callable[[int, int], None]
"""Called with (events folded, events in all) from time to time."""

_PROGRESS_EVERY: Final = 500


class HistoryRecorder:
    """The tables of a log's history under some settings and commands; without ``cache`` they are in
    memory only."""

    def __init__(
        self,
        reader: LogReader,
        settings: Settings,
        corrections: Corrections,
        cache: TimelineCache | None,
        progress: Progress | None,
    ) -> None:
        self._reader, self._settings, self._corrections = reader, settings, corrections
        self._cache, self._progress = cache, progress
        self._map: SemanticMap | None = None
        self._tables: Tables | None = None
        self._read = 0  # stripes that were read from the cache
        self._kept = FIRST_OFFSET

    def has(self, end: Offset) -> bool:
        """Whether ``end`` events are folded, or in the cache."""
        return end <= self._opened().end

    def up_to(self, end: Offset) -> Tables:
        """The tables of at least the first ``end`` events; folds those that are missing. Raises
        FoldError at a bad event; what was folded before it stays."""
        tables = self._opened()
        if tables.end < end:
            self._fold_on(end)
            self._keep()
        return self._opened()

    def _opened(self) -> Tables:
        if self._tables is None:
            found = self._cache.stripes(self._reader.next_offset) if self._cache else []
            return self._start(found)
        return self._tables

    def _start(self, stripes: list[Stripe]) -> Tables:
        self._tables, self._map = Tables(stripes, self._folded_again), None
        self._read, self._kept = len(stripes), self._tables.end
        return self._tables

    def _fold_on(self, end: Offset) -> None:
        tables = self._opened()
        if self._map is None and tables.end > FIRST_OFFSET:
            self._map = self._cache.fold_at(tables.end) if self._cache else None
            if self._map is None:
                self._start([])
        if self._map is None:
            self._map = new_map(self._reader, self._settings, self._corrections)
        self._fold(self._map, end)

    def _fold(self, semantic_map: SemanticMap, end: Offset) -> None:
        """Fold up to ``end`` and add the rows to the tables."""
        tables = self._opened()
        writer = TableWriter(tables)
        events = self._reader.read(tables.end, end)
        try:
            with gc_paused():
                for folded in fold_events(events, semantic_map, ahead=READ_AHEAD):
                    writer.add(folded.offset, folded.deltas)
                    if self._progress and folded.offset % _PROGRESS_EVERY == 0:
                        self._progress(folded.offset, end)
        finally:
            writer.flush()
            tables.shorten(self._read)
        if self._progress:
            self._progress(end, end)

    def _keep(self) -> None:
        tables = self._opened()
        if self._cache is None or self._map is None or self._map.next_offset != tables.end:
            return
        if self._cache.is_worth(tables.end - self._kept):
            self._cache.keep(tables.stripes, self._map)
            self._kept = tables.end

    def _folded_again(self, end: Offset, damage: DamagedPart) -> list[Stripe]:
        """The stripes of ``end`` events folded from the log again, after a cached part was
        damaged."""
        if self._cache is not None:
            self._cache.forget(damage)
        # With a reader of its own: a map may be looked at after its timeline was closed.
        with LogReader(self._reader.path) as reader:
            again = HistoryRecorder(reader, self._settings, self._corrections, None, self._progress)
            stripes = again.up_to(end).stripes
            self._read, self._kept, self._map = 0, FIRST_OFFSET, None
            if self._cache is not None and again._map is not None:
                self._cache.keep(stripes, again._map)
                self._kept = end
        return stripes


def map_at(reader: LogReader, offset: Offset) -> OccupancyMap:
    """The occupancy map in the event at ``offset``."""
    (event,) = parse_events(list(reader.read(offset, Offset(offset + 1))))
    if not isinstance(event.parsed, OccupancyMap):
        raise FoldError(offset, "its history says that it is an occupancy map")
    return event.parsed
