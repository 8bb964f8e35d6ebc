"""The history of one log under given settings and the commands recorded before a point.

The first question that needs the history folds the log once. The history is kept in memory and
beside the log (`projections.store.timeline_cache`); later questions are look-ups. An event at
offset o, and a merge it causes, shows in ``at(o + 1)``. A command shows in every map of a history
that knows it.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeVar

from eventsrc.base.errors import LogDamaged, MisuseError
from eventsrc.base.garbage import gc_paused
from eventsrc.base.text import counted
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.errors import FoldError, LogPointError
from projections.fold.settings import Settings
from projections.map.fold import READ_AHEAD, FoldedEvent, fold_events, fold_log_cached
from projections.map.snapshot_cache import SnapshotCache
from projections.map.space_vectors import new_map, with_vectors
from projections.map.view import MapView
from projections.store.history_recorder import HistoryRecorder, map_at
from projections.store.history_recorder import Progress as Progress
from projections.store.records import Merge, ObjectMerge, Refusal
from projections.store.stored_history import StoredHistory
from projections.store.stored_view import StoredView
from projections.store.timeline_cache import TimelineCache

from .bisect import CountIndex, HistoryFacts, Search, Searcher
from .command_entries import EntryMaker, object_commands, place_commands, same_place_commands
from .conditions import Expression
from .explanation import Explanation, explain_object, explain_place, with_entries
from .names import (
    NoSuchThing,
    find_keyframe,
    find_object,
    find_place,
    id_of_place,
    keyframe_ordinal,
)
from .same_place import explain_same_place

_Caused = TypeVar("_Caused", Merge, Refusal, ObjectMerge)


def checked_end(reader: LogReader, end: Offset | None) -> Offset:
    """``end``, the end of the log for None. Raises LogPointError for one beyond the log."""
    if end is None:
        return reader.next_offset
    if not 0 <= end <= reader.next_offset:
        raise LogPointError(
            f"{end} is no point in {reader.path}, which holds "
            f"{counted(reader.next_offset, 'event')}; give 0 to {reader.next_offset}"
        )
    return end


class KnownHistory:
    """The history of a log under ``settings`` and ``corrections``; an ``end`` is a number of
    events.

    ``progress`` is called while events are folded, ``note`` with a line about each snapshot or kept
    history that could not be used. Without ``cache`` no history is read or kept beside the log.
    """

    def __init__(
        self,
        reader: LogReader,
        settings: Settings,
        corrections: Corrections,
        *,
        progress: Progress | None = None,
        note: Callable[[str], None] = lambda _: None,
        cache: bool = True,
    ) -> None:
        self.reader = reader
        self.settings = settings
        self.corrections = corrections
        self._note = note
        self._snapshot_tried = False
        self._cache = TimelineCache(reader, settings, corrections, note) if cache else None
        self._recorder = HistoryRecorder(reader, settings, corrections, self._cache, progress)
        self._history: StoredHistory | None = None
        self._latest: StoredView | None = None
        self._index: CountIndex | None = None
        self._entries = EntryMaker(reader)

    @property
    def end(self) -> Offset:
        """The number of events in the log as of opening or the timeline's last refresh."""
        return self.reader.next_offset

    @property
    def history(self) -> StoredHistory:
        """The history up to `end`; folds new events first. Raises FoldError at a bad event."""
        return self._history_of(self.end)

    @property
    def latest(self) -> MapView:
        """The map up to `end`, read-only; its observations carry no embeddings."""
        return self._whole_view(self.history)

    def _whole_view(self, history: StoredHistory) -> StoredView:
        if self._latest is None or self._latest.next_offset != history.next_offset:
            self._latest = StoredView(history, history.next_offset, self._cache)
        return self._latest

    def covering(self, end: Offset) -> StoredHistory:
        """The history of all that can be read and folded, for a question about the map after
        ``end`` events. Raises FoldError, LogDamaged for an event before ``end`` only."""
        try:
            return self.history
        except (FoldError, LogDamaged):
            if not self._recorder.has(end):
                raise
        return self._history_of(end)

    def _history_of(self, end: Offset) -> StoredHistory:
        """The history of ``end`` events or more."""
        tables = self._recorder.up_to(end)
        if self._history is None or self._history.tables is not tables:
            self._index = None
            self._history = StoredHistory(
                self.settings, self.corrections, tables, partial(map_at, self.reader)
            )
        return self._history

    def at(self, end: Offset | None = None) -> MapView:
        """The map after the first ``end`` events, all of them for None; the caller may change it.

        Its observations carry no embeddings, only their checksums. Without a history that was kept,
        the first call folds from the nearest snapshot beside the log, if there is one; a later call
        folds the history, from then on it is a look-up.
        """
        wanted = self._checked(end)
        if not self._recorder.has(wanted) and not self._snapshot_tried:
            self._snapshot_tried = True
            if self._has_snapshot(wanted):
                return self.folded(wanted)
        known = self._recorder.has(wanted)
        return self._view(self._history_of(wanted) if known else self.covering(wanted), wanted)

    def at_once(self, end: Offset) -> MapView:
        """`at`, for one question: events from ``end`` on are not folded."""
        if not self._recorder.has(end) and self._has_snapshot(end):
            return self.folded(end)
        return self._view(self._history_of(end), end)

    def folded(self, end: Offset) -> MapView:
        """The map at ``end``, folded from the nearest snapshot."""
        return fold_log_cached(
            self.reader, self.settings, end, note=self._note, corrections=self.corrections
        )[1]

    def _view(self, history: StoredHistory, end: Offset) -> MapView:
        """The map at ``end`` from a history of as many events or more."""
        with gc_paused():
            return StoredView(history, end, self._cache)

    def deltas(
        self, start: Offset = FIRST_OFFSET, end: Offset | None = None
    ) -> Iterator[FoldedEvent]:
        """The deltas of each event from ``start`` to before ``end``, by a separate fold from the
        nearest snapshot."""
        found = self._snapshots().latest(self._checked(start))
        if found is None:
            semantic_map = new_map(self.reader, self.settings, self.corrections)
        else:
            semantic_map = with_vectors(found[0], self.reader)
        events = self.reader.read(semantic_map.next_offset, self._checked(end))
        folded = fold_events(events, semantic_map, ahead=READ_AHEAD)
        return (event for event in folded if event.offset >= start)

    def merges(self, end: Offset | None = None) -> list[Merge]:
        """Every merge of places by the first ``end`` events, in order."""
        last = self._checked(end)
        return _before(self.covering(last).merges, last)

    def refusals(self, end: Offset | None = None) -> list[Refusal]:
        """Every merge that a command refused in the first ``end`` events, in order."""
        last = self._checked(end)
        return _before(self.covering(last).refusals, last)

    def object_merges(self, end: Offset | None = None) -> list[ObjectMerge]:
        """Every merge of objects by the first ``end`` events, in order."""
        last = self._checked(end)
        return _before(self.covering(last).object_merges, last)

    def why(self, thing: str, end: Offset | None = None) -> Explanation:
        """The history of a place or an object, and the commands about it.

        ``thing`` is an id, or the name of a place. Raises NoSuchThing with the nearest names.
        """
        last = self._checked(end)
        history = self.covering(last)
        if thing in history.object_ordinals:
            seen = self._whole_view(history).observations.__getitem__
            explained = explain_object(history, seen, find_object(history, thing), last)
            commands = object_commands(self._entries, history, explained.facts["det_ids"])
            return with_entries(explained, commands)
        if thing not in history.place_ordinals and thing.startswith("obj-"):
            raise NoSuchThing("object", thing, history.object_ordinals)
        try:
            place = find_place(history, thing, last)
        except NoSuchThing:
            _refuse_keyframe(history, thing, last)
            raise
        commands = place_commands(self._entries, history, place, last)
        return with_entries(explain_place(history, place, last), commands)

    def why_same(self, first: str, second: str, end: Offset | None = None) -> Explanation:
        """Since when, and by which merges, two keyframes (``run:keyframe``) are in one place; which
        commands join them or keep them apart."""
        last = self._checked(end)
        history = self.covering(last)
        a, b = (find_keyframe(history, text) for text in (first, second))
        commands = same_place_commands(self._entries, history, (a, b), last)
        return with_entries(explain_same_place(history, a, b, last), commands)

    def facts(self, end: Offset | None = None) -> HistoryFacts:
        """The map after ``end`` events, for evaluating conditions."""
        last = self._checked(end)
        history = self.covering(last)
        if self._index is None:
            self._index = CountIndex(history)
        return HistoryFacts(history, self._index, last)

    def bisect(
        self,
        expression: Expression | str,
        start: Offset = FIRST_OFFSET,
        end: Offset | None = None,
        *,
        scan: bool = False,
    ) -> Search:
        """The first event from ``start`` on that made a condition true; with ``scan``, all turns.

        Raises ExpressionError for a text that cannot be read or names what is not in the log.
        """
        asked = Expression(expression) if isinstance(expression, str) else expression
        facts = self.facts(end)
        if self._checked(start) > facts.end:
            raise LogPointError(f"the start ({start}) is after the end ({facts.end}); swap them")
        _check_names(asked, facts)
        cause_at = self.covering(facts.end).cause_at
        return Searcher(asked, facts, cause_at).search(start, facts.end, scan=scan)

    def _checked(self, end: Offset | None) -> Offset:
        return checked_end(self.reader, end)

    def _has_snapshot(self, end: Offset) -> bool:
        return any(offset <= end for offset in self._snapshots().offsets())

    def _snapshots(self) -> SnapshotCache:
        return SnapshotCache(
            self.reader.path,
            self.reader.log_id,
            self.settings,
            self._note,
            corrections=self.corrections,
        )


def map_after(
    reader: LogReader,
    settings: Settings,
    end: Offset,
    *,
    corrections: Corrections,
    note: Callable[[str], None],
    cache: bool = True,
) -> MapView:
    """The map after ``end`` events, for one question: from the history that is kept beside the log,
    else from the nearest snapshot. Without either the events are folded, and their history kept."""
    known = KnownHistory(reader, settings, corrections, note=note, cache=cache)
    return known.at_once(end) if cache else known.folded(end)


def _before(records: Sequence[_Caused], end: Offset) -> list[_Caused]:
    return [record for record in records if record.cause.offset < end]


def _check_names(expression: Expression, facts: HistoryFacts) -> None:
    """Raise ExpressionError for a name that is not in the log: a condition on it would never
    hold."""
    for mention in expression.mentions():
        if not facts.has(mention.kind, mention.text):
            error = NoSuchThing(mention.kind.value, mention.text, facts.names(mention.kind))
            raise expression.error_at(mention.column, str(error))


def _refuse_keyframe(history: StoredHistory, text: str, end: Offset) -> None:
    """Raise MisuseError if ``text`` is a keyframe: alone it has no explanation."""
    keyframe = keyframe_ordinal(history, text)
    if keyframe is None:
        return
    place = id_of_place(history, history.place_at(keyframe, end))
    raise MisuseError(
        f"{text} is a keyframe, in {place or 'no place'}; give a place, an object or two keyframes"
    )
