"""The maps of one log under one setting at every offset, and why they are as they are.

A timeline folds its log once, at the first question, and keeps the history; after that every
question is a look-up. An event at offset o, and a merge it causes, shows in ``at(o + 1)``.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from eventsrc.text import counted
from projections.errors import LogPointError
from projections.model.digest import map_digest
from projections.model.fold import READ_AHEAD, FoldedEvent, fold_events, fold_log_cached, gc_paused
from projections.model.snapshot_cache import SnapshotCache
from projections.model.view import MapView
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings

from .bisect import CountIndex, HistoryFacts, Search, Searcher
from .conditions import Expression
from .diff import Difference, difference_of, rows_of
from .explanation import Explanation, explain_object, explain_place
from .history import History, view_at
from .names import NoSuchThing, find_keyframe, find_object, find_place, place_name
from .records import Cause, Merge
from .same_place import explain_same_place

Progress: TypeAlias = Callable[[int, int], None]
"""Called with (events folded, events in all) from time to time."""

_PROGRESS_EVERY = 500


class Timeline:
    """A context manager over a log. An ``end`` means the map after that many events.

    ``progress`` is called while events are folded, ``note`` with a line about each snapshot that
    could not be used.
    """

    def __init__(
        self,
        log: Path,
        settings: Settings | None = None,
        *,
        progress: Progress | None = None,
        note: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.settings = settings or Settings()
        self.reader = LogReader(log)
        self._progress = progress
        self._note = note
        self._snapshot_tried = False
        self._map = SemanticMap(self.settings)
        self._latest = MapView(self.settings, keep_embeddings=False)
        self._history = History(self.settings)
        self._index: CountIndex | None = None

    def __enter__(self) -> "Timeline":
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()

    @property
    def end(self) -> Offset:
        """The number of events in the log as of opening or the last `refresh`."""
        return self.reader.next_offset

    def refresh(self) -> Offset:
        """Include events recorded since; returns the new `end`."""
        return self.reader.refresh()

    @property
    def history(self) -> History:
        """The history up to `end`; folds new events first. Raises FoldError at a bad event."""
        if self._history.next_offset < self.end:
            self._index = None
            with gc_paused():
                self._fold_to(self.end)
        return self._history

    def at(self, end: Offset | None = None) -> MapView:
        """The map after the first ``end`` events, all of them for None; the caller may change it.

        Its observations carry no embeddings, only their checksums. The first call folds from the
        nearest snapshot beside the log, if there is one; a later call folds the history, from then
        on it is a look-up.
        """
        wanted = self._end(end)
        if self._history.next_offset < wanted and not self._snapshot_tried:
            self._snapshot_tried = True
            if (view := self._from_snapshot(wanted)) is not None:
                return view
        history = self.history
        with gc_paused():
            return view_at(history, self._latest, wanted, self.settings)

    def deltas(
        self, start: Offset = FIRST_OFFSET, end: Offset | None = None
    ) -> Iterator[FoldedEvent]:
        """The deltas of each event from ``start`` to before ``end``, by a separate fold from the
        nearest snapshot."""
        found = self._snapshots().latest(self._end(start))
        semantic_map = SemanticMap(self.settings) if found is None else found[0]
        events = self.reader.read(semantic_map.next_offset, self._end(end))
        folded = fold_events(events, semantic_map, ahead=READ_AHEAD)
        return (event for event in folded if event.offset >= start)

    def merges(self, end: Offset | None = None) -> list[Merge]:
        """Every merge of places by the first ``end`` events, in order."""
        before = self._end(end)
        return [merge for merge in self.history.merges if merge.cause.offset < before]

    def why(self, thing: str, end: Offset | None = None) -> Explanation:
        """What happened to a place or an object; raises NoSuchThing with the nearest names."""
        history = self.history
        if thing in history.object_ordinals:
            found = find_object(history, thing)
            det_ids = [self._latest.observations[s.observation].det_id for s in found.sightings]
            return explain_object(history, det_ids, found, self._end(end))
        if thing not in history.place_ordinals and thing.startswith("obj-"):
            raise NoSuchThing("object", thing, history.object_ordinals)
        return explain_place(history, find_place(history, thing), self._end(end))

    def why_same(self, first: str, second: str, end: Offset | None = None) -> Explanation:
        """Since when, and by which merges, two keyframes (``run:keyframe``) are in one place."""
        a, b = (find_keyframe(self.history, text) for text in (first, second))
        return explain_same_place(self.history, a, b, self._end(end))

    def diff(self, start: Offset, end: Offset | None = None) -> Difference:
        """The difference between the maps after ``start`` and after ``end`` events."""
        last = self._end(end)
        before, after = self.at(start), self.at(last)
        return difference_of(
            start,
            last,
            (rows_of(before), rows_of(after)),
            (map_digest(before), map_digest(after)),
            (before.counts(), after.counts()),
            self._absorbed(start, last),
        )

    def facts(self, end: Offset | None = None) -> HistoryFacts:
        """The map after ``end`` events, for evaluating conditions."""
        history = self.history
        if self._index is None:
            self._index = CountIndex(history)
        return HistoryFacts(history, self._index, self._end(end))

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
        if self._end(start) > facts.end:
            raise LogPointError(f"from {start} to {facts.end} nothing happens; swap them")
        self._check_names(asked, facts)
        return Searcher(asked, facts, self.history.cause_at).search(start, facts.end, scan=scan)

    def _end(self, end: Offset | None) -> Offset:
        if end is None:
            return self.end
        if not 0 <= end <= self.end:
            raise LogPointError(
                f"{end} is no point in {self.reader.path}, which holds "
                f"{counted(self.end, 'event')}; give 0 to {self.end}"
            )
        return end

    def _fold_to(self, end: Offset) -> None:
        events = self.reader.read(self._history.next_offset, end)
        for folded in fold_events(events, self._map, ahead=READ_AHEAD):
            self._latest.apply_event(folded.offset, folded.deltas)
            self._history.apply(folded.offset, folded.deltas)
            if self._progress and folded.offset % _PROGRESS_EVERY == 0:
                self._progress(folded.offset, end)
        if self._progress:
            self._progress(end, end)

    def _from_snapshot(self, end: Offset) -> MapView | None:
        """The map at ``end`` from the nearest snapshot; None when there is none below."""
        if not any(offset <= end for offset in self._snapshots().offsets()):
            return None
        return fold_log_cached(self.reader, self.settings, end, note=self._note)[1]

    def _snapshots(self) -> SnapshotCache:
        return SnapshotCache(self.reader.path, self.reader.log_id, self.settings, self._note)

    def _check_names(self, expression: Expression, facts: HistoryFacts) -> None:
        """Raises ExpressionError for a name that is not in the log: a condition on it would never
        hold."""
        for mention in expression.mentions():
            names = facts.names(mention.kind)
            if mention.text not in names:
                error = NoSuchThing(mention.kind.value, mention.text, names)
                raise expression.error_at(mention.column, str(error))

    def _absorbed(self, start: Offset, end: Offset) -> dict[str, tuple[str, Cause]]:
        history = self.history
        return {
            place_name(history, place): (place_name(history, merge.survivor), merge.cause)
            for merge in history.merges
            if start <= merge.cause.offset < end
            for place in merge.absorbed
        }
