"""The maps of a log: folds it into the tables of a history, from the end of the cached history on.

Every answer about the map after W events is read from here (`map_after`, `HistoryRecorder.at`).
Long folds are cached beside the log, so that the next process folds only later events.

**An interrupted fold is continued or discarded.** An exception, such as that of Ctrl-C, can come at
any moment. A fold raises its ``next_offset`` before an event changes it, and a `TableWriter` its
``end`` when the rows of the event are complete. So the two agree exactly between events, and only
then are fold and tables kept, both by one assignment. Until then there are the tables from before.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final, NamedTuple, TypeAlias

from eventsrc.base.errors import LogError
from eventsrc.base.machine import gc_paused
from eventsrc.envelope.commands import NamePlace
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.log import LogReader
from projections.fold.corrections import NO_CORRECTIONS, Corrections, compile_corrections
from projections.fold.map_errors import FoldError
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.fold import fold_events, fold_into, fold_log, new_map
from projections.map.parsing import READ_AHEAD, parse_events
from projections.map.view import MapView

from .columns import STRIPE_EVENTS, Stripe, joined
from .history import History
from .stored_view import StoredView
from .tables import DamagedPart, Tables, TableWriter
from .timeline_cache import TimelineCache
from .vectors import RecordedVectors

Progress: TypeAlias = Callable[[int, int], None]
"""Called with (events folded, events in all) from time to time."""

_PROGRESS_EVERY: Final = 500


class _Folded(NamedTuple):
    """``map`` is the fold at the end of ``tables``, if it is in memory. The first ``read`` stripes
    are from the cache, which has the first ``kept`` events."""

    tables: Tables
    map: SemanticMap | None = None
    read: int = 0
    kept: Offset = FIRST_OFFSET


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
        self._folded: _Folded | None = None
        self._history: History | None = None

    def history(self, end: Offset) -> History:
        """The history of ``end`` events or more; raises as `up_to`."""
        tables, history = self.up_to(end), self._history
        if history is None or history.tables is not tables:
            map_of = partial(map_at, self._reader)
            history = History(self._settings, self._corrections, tables, map_of)
            self._history = history
        return history

    def at(self, end: Offset, *, embeddings: bool = False) -> StoredView:
        """The map after ``end`` events; the caller may change it. Its observations carry no
        embeddings, only their checksums; with ``embeddings`` it has `vectors`. Raises as
        `up_to`."""
        history = self.history(end)
        vectors = RecordedVectors(self._reader, history, end, self._cache) if embeddings else None
        with gc_paused():
            return StoredView(history, end, self._cache, vectors.of if vectors else None)

    def resumed(self, limit: Offset) -> tuple[SemanticMap, StoredView] | None:
        """The latest cached fold of at most ``limit`` events, and its map; None if there is none.
        Both are the caller's to fold on, with a `writer` to keep the history of what follows."""
        found = self.fold_before(Offset(min(limit, self._opened().tables.end)))
        return None if found is None else (found, self.at(found.next_offset))

    def writer(self) -> TableWriter:
        """A writer of the rows that are missing, of which `keep` makes a part of the cache."""
        return TableWriter(self._opened().tables, short=True)

    def keep(self, writer: TableWriter, semantic_map: SemanticMap) -> None:
        """Cache the rows of a `writer` whose last event is that of the fold, if there are many."""
        self._add(self._opened(), writer, semantic_map)
        self._keep()

    @property
    def end(self) -> Offset:
        """The number of events that are folded, or in the cache."""
        return self._opened().tables.end

    def up_to(self, end: Offset) -> Tables:
        """The tables of at least the first ``end`` events; folds those that are missing. Raises
        FoldError at a bad event; what was folded before it stays."""
        if self.end < end:
            self._fold_on(end)
            self._keep()
        return self._opened().tables

    def _opened(self) -> _Folded:
        if self._folded is None:
            if self._cache is not None and self._reader.segments[-1].away:
                from eventsrc.log.archived_history import stand_for_kept  # here: few logs are away

                stand_for_kept(self._reader.path)
            found = self._cache.stripes(self._reader.readable_end) if self._cache else []
            self._folded = self._of(found)
        return self._folded

    def _of(self, stripes: list[Stripe]) -> _Folded:
        tables = Tables(stripes, self._folded_again)
        return _Folded(tables, None, len(stripes), tables.end)

    def _fold_on(self, end: Offset) -> None:
        before = self._opened()
        semantic_map = before.map or self.fold_before(before.tables.end)
        if semantic_map is None:
            before = self._of([])
            semantic_map = new_map(self._reader, self._settings, self._corrections)
        self._folded = before._replace(map=None)  # as the fold is changed now
        writer = TableWriter(before.tables)
        try:
            self._fold(semantic_map, writer, end)
        finally:
            self._add(before, writer, semantic_map)

    def _add(self, before: _Folded, writer: TableWriter, semantic_map: SemanticMap) -> None:
        if semantic_map.next_offset == writer.end:  # else it ended in the midst of an event
            found = [*before.tables.stripes, *writer.finish()]
            tables = Tables(_with_short_joined(found, before.read), self._folded_again)
            self._folded = before._replace(tables=tables, map=semantic_map)

    def fold_before(self, limit: Offset) -> SemanticMap | None:
        """The latest cached fold of at most ``limit`` events; None if there is none."""
        return self._cache.fold_before(limit) if self._cache is not None else None

    def _fold(self, semantic_map: SemanticMap, writer: TableWriter, end: Offset) -> None:
        """Fold up to ``end`` and add the rows."""
        events = self._reader.read(semantic_map.next_offset, end)
        with gc_paused():
            for folded in fold_events(events, semantic_map, ahead=READ_AHEAD):
                if folded.offset >= writer.end:  # else the fold is behind the tables
                    writer.add(folded.offset, folded.deltas)
                if self._progress and folded.offset % _PROGRESS_EVERY == 0:
                    self._progress(folded.offset, end)
        if self._progress:
            self._progress(end, end)

    def _keep(self) -> None:
        folded = self._opened()
        end = folded.tables.end
        if self._cache is None or folded.map is None or folded.map.next_offset != end:
            return
        if self._cache.is_worth(end - folded.kept):
            self._cache.keep(folded.tables.stripes, folded.map)
            self._folded = folded._replace(kept=end)

    def _folded_again(self, end: Offset, damage: DamagedPart) -> list[Stripe]:
        """The stripes of ``end`` events folded from the log again, after a cached part was
        damaged. Raises LogError if the log has them no more."""
        if self._cache is not None:
            self._cache.forget(damage)
        # With a reader of its own: a map may be looked at after its timeline was closed.
        with LogReader(self._reader.path) as reader:
            again = HistoryRecorder(reader, self._settings, self._corrections, None, self._progress)
            if reader.log_id != self._reader.log_id or reader.end_for(end) < end:
                raise LogError(
                    f"{damage}, and the log at {reader.path} is another one now or has lost events;"
                    " open it again"
                )
            tables = again.up_to(end)
            folded = again._opened()
            if self._cache is not None and folded.map is not None:
                self._cache.keep(tables.stripes, folded.map)
        return tables.stripes


def _with_short_joined(stripes: Sequence[Stripe], first: int) -> list[Stripe]:
    """The same rows, with the last stripes joined while they are short; those before the index
    ``first`` stay."""
    found = list(stripes)
    while len(found) > first + 1:
        *_, one, other = found
        events = other.end - other.start
        if other.end - one.start > STRIPE_EVENTS or 2 * events < one.end - one.start:
            break
        found[-2:] = [joined([one, other])]
    return found


def map_after(
    reader: LogReader,
    settings: Settings,
    end: Offset | None = None,
    *,
    corrections: Corrections = NO_CORRECTIONS,
    note: Callable[[str], None] = lambda _: None,
    cache: bool = True,
    embeddings: bool = False,
) -> MapView:
    """The map after ``end`` events, all of them for None: from the history that is kept beside the
    log, folding only events that it lacks. With ``embeddings`` the map has `vectors`.

    ``note`` is called with a line about each part of the history that could not be used or kept.
    Without ``cache`` the log is folded and nothing kept. Raises FoldError, LogDamaged.
    """
    last = reader.end_for(end)
    if not cache:
        return fold_log(
            reader, settings, last, keep_embeddings=embeddings, corrections=corrections
        )[1]
    if corrections.names and not embeddings:
        found = resumed_under_other_names(reader, settings, corrections, last, note)
        if found is not None:
            fold_into(reader, *found, last)
            return found[1]
    kept = TimelineCache(reader, settings, corrections, note)
    recorder = HistoryRecorder(reader, settings, corrections, kept, None)
    return recorder.at(last, embeddings=embeddings)


def resumed_under_other_names(
    reader: LogReader,
    settings: Settings,
    corrections: Corrections,
    limit: Offset,
    note: Callable[[str], None],
) -> tuple[SemanticMap, MapView] | None:
    """`HistoryRecorder.resumed`, from a history that knows fewer names of places if need be."""
    for known in _fewer_names(corrections):
        cache = TimelineCache(reader, settings, known, note)
        found = HistoryRecorder(reader, settings, known, cache, None).resumed(limit)
        if found is not None:
            semantic_map, view = found
            for delta in semantic_map.use_names(semantic_map.next_offset, corrections):
                view.apply(delta)
            view.corrections = corrections
            return found
    return None


def _fewer_names(corrections: Corrections) -> Iterator[Corrections]:
    """The corrections, and those before each of the last commands if these gave names only."""
    yield corrections
    known = list(corrections.in_force)
    while known and isinstance(known.pop().command, NamePlace):
        yield compile_corrections(known)


def map_at(reader: LogReader, offset: Offset) -> OccupancyMap:
    """The occupancy map in the event at ``offset``."""
    (event,) = parse_events(list(reader.read(offset, Offset(offset + 1))))
    if not isinstance(event.parsed, OccupancyMap):
        raise FoldError(offset, "its history says that it is an occupancy map")
    return event.parsed
