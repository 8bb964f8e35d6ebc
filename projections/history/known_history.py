"""The history of one log under given settings and the commands recorded before a point.

The first question that needs the history folds the log once. The history is kept in memory and
beside the log (`projections.store.timeline_cache`); later questions are look-ups. An event at
offset o, and a merge it causes, shows in ``at(o + 1)``. A command shows in every map of a history
that knows it.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from eventsrc.base.errors import LogDamaged, MisuseError
from eventsrc.base.text import counted
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.map_errors import FoldError, LogPointError
from projections.fold.settings import Settings
from projections.map import naming
from projections.map.fold import FoldedEvent, fold_events, new_map
from projections.map.parsing import READ_AHEAD
from projections.map.view import MapView
from projections.store.history import History
from projections.store.history_recorder import HistoryRecorder
from projections.store.history_recorder import Progress as Progress
from projections.store.history_records import Merge, ObjectMerge, RefusedMerge
from projections.store.stored_view import StoredView
from projections.store.timeline_cache import TimelineCache

from . import names
from .bisect import Search, Searcher
from .command_entries import EntryMaker, object_commands, place_commands, same_place_commands
from .condition_functions import CountIndex, HistoryFacts, Names
from .conditions import Expression
from .explanation import Explanation, explain_place, explain_same_place, with_entries
from .object_explanation import explain_object

_Caused = TypeVar("_Caused", Merge, RefusedMerge, ObjectMerge)


def checked_end(reader: LogReader, end: Offset | None) -> Offset:
    """``end``, the end of the log for None. Raises LogPointError for one beyond the log."""
    if end is None:
        return reader.next_offset
    if not 0 <= end <= reader.end_for(end):
        raise LogPointError(
            f"{end} is no point in {reader.path}, which holds "
            f"{counted(reader.next_offset, 'event')}; give 0 to {reader.next_offset}"
        )
    return end


class KnownHistory:
    """The history of a log under ``settings`` and ``corrections``; an ``end`` is a number of
    events.

    ``progress`` is called while events are folded, ``note`` with a line about each part of a
    kept history that could not be used. Without ``cache`` none is read or kept beside the log.
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
        kept = TimelineCache(reader, settings, corrections, note) if cache else None
        self._recorder = HistoryRecorder(reader, settings, corrections, kept, progress)
        self._latest: StoredView | None = None
        self._index: tuple[History, CountIndex] | None = None
        self._short: tuple[Offset, naming.ShortIds] | None = None
        self._entries = EntryMaker(reader)

    @property
    def end(self) -> Offset:
        """The number of events in the log as of opening or the timeline's last refresh."""
        return self.reader.next_offset

    @property
    def history(self) -> History:
        """The history up to `end`; folds new events first. Raises FoldError at a bad event."""
        return self._history_of(self.end)

    @property
    def latest(self) -> MapView:
        """The map up to `end`, read-only; its observations carry no embeddings."""
        return self._whole_view(self.history)

    def _whole_view(self, history: History) -> StoredView:
        if self._latest is None or self._latest.next_offset != history.next_offset:
            self._latest = self._recorder.at(history.next_offset)
        return self._latest

    def covering(self, end: Offset) -> History:
        """The history of all that can be read and folded, for a question about the map after
        ``end`` events. Raises FoldError, LogDamaged for an event before ``end`` only."""
        try:
            return self._history_of(self.reader.readable_end)
        except (FoldError, LogDamaged):
            if self._recorder.end < end:
                raise
        return self._history_of(end)

    def _history_of(self, end: Offset) -> History:
        """The history of ``end`` events or more."""
        return self._recorder.history(end)

    def at(self, end: Offset | None = None) -> MapView:
        """The map after the first ``end`` events, all of them for None; the caller may change it.

        Its observations carry no embeddings, only their checksums; where words are compared with
        them it has `vectors`. The first call folds the history, unless one was kept; from then on
        it is a look-up.
        """
        wanted = self._checked(end)
        if self._recorder.end < wanted:
            self.covering(wanted)  # folds the whole log, not only up to ``wanted``
        return self._recorder.at(wanted, embeddings=self.settings.text_encoder is not None)

    def deltas(
        self, start: Offset = FIRST_OFFSET, end: Offset | None = None
    ) -> Iterator[FoldedEvent]:
        """The deltas of each event from ``start`` to before ``end``, by a separate fold from the
        nearest kept one."""
        kept = self._recorder.fold_before(self._checked(start))
        semantic_map = kept or new_map(self.reader, self.settings, self.corrections)
        events = self.reader.read(semantic_map.next_offset, self._checked(end))
        folded = fold_events(events, semantic_map, ahead=READ_AHEAD)
        return (event for event in folded if event.offset >= start)

    def merges(self, end: Offset | None = None) -> list[Merge]:
        """Every merge of places by the first ``end`` events, in order."""
        last = self._checked(end)
        return _before(self.covering(last).merges, last)

    def refusals(self, end: Offset | None = None) -> list[RefusedMerge]:
        """Every merge that a command refused in the first ``end`` events, in order."""
        last = self._checked(end)
        return _before(self.covering(last).refusals, last)

    def object_merges(self, end: Offset | None = None) -> list[ObjectMerge]:
        """Every merge of objects by the first ``end`` events, in order."""
        last = self._checked(end)
        return _before(self.covering(last).object_merges, last)

    def why(self, thing: str, end: Offset | None = None) -> Explanation:
        """The history of a place or an object, and the commands about it.

        ``thing`` is what `projections.map.naming.matches` takes. Raises NoSuchThing with the
        nearest names, and SeveralThings.
        """
        last = self._checked(end)
        history = self.covering(last)
        _refuse_keyframe(history, thing, last)
        found = naming.thing_called(thing, self.things(last), ("place", "object"))
        if found.kind == "object":
            seen = self._whole_view(history).observations.__getitem__
            explained = explain_object(history, seen, history.objects[found.ordinal], last)
            commands = object_commands(
                self._entries, history, explained.facts["det_ids"], explained.facts["class_name"]
            )
            return with_entries(explained, commands)
        place = history.places[found.ordinal]
        commands = place_commands(self._entries, history, place, last)
        return with_entries(explain_place(history, place, last), commands)

    def things(self, end: Offset) -> list[naming.Thing]:
        """What may be called by a name after ``end`` events; see `things_at`."""
        history = self.covering(end)
        return names.things_at(history, self._recorder.at(end))

    def short_ids(self, end: Offset) -> naming.ShortIds:
        """The short ids of the map after ``end`` events."""
        kept = self._short
        if kept is None or kept[0] != end:
            self._short = kept = end, naming.ShortIds.of(naming.things_of(self.at(end)))
        return kept[1]

    def shortened(self, text: str, end: Offset) -> str:
        """``text`` with the short ids of the map after ``end`` events, once that is folded."""
        return text if self._recorder.end < end else self.short_ids(end).text(text)

    def why_same(self, first: str, second: str, end: Offset | None = None) -> Explanation:
        """Since when, and by which merges, two keyframes (``run:keyframe``) are in one place; which
        commands join them or keep them apart."""
        last = self._checked(end)
        history = self.covering(last)
        a, b = (names.find_keyframe(history, text) for text in (first, second))
        commands = same_place_commands(self._entries, history, (a, b), last)
        return with_entries(explain_same_place(history, a, b, last), commands)

    def facts(self, end: Offset | None = None) -> HistoryFacts:
        """The map after ``end`` events, for evaluating conditions."""
        last = self._checked(end)
        history = self.covering(last)
        if self._index is None or self._index[0] is not history:
            self._index = history, CountIndex(history)
        return HistoryFacts(history, self._index[1], last)

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
        self._find_names(asked, facts)
        cause_at = self.covering(facts.end).cause_at
        return Searcher(asked, facts, cause_at).search(start, facts.end, scan=scan)

    def _find_names(self, expression: Expression, facts: HistoryFacts) -> None:
        """Tell ``facts`` what the names in a condition mean. Raises ExpressionError for one that
        is not in the log: a condition on it would never hold."""
        things: list[naming.Thing] | None = None
        for mention in expression.mentions():
            if facts.has(mention.kind, mention.text):
                continue
            if mention.kind not in (Names.PLACE, Names.OBJECT):
                error = naming.NoSuchThing(
                    mention.kind.value, mention.text, facts.names(mention.kind)
                )
                raise expression.error_at(mention.column, str(error))
            things = self.things(facts.end) if things is None else things
            kind: naming.Kind = "place" if mention.kind is Names.PLACE else "object"
            try:
                found = naming.thing_called(mention.text, things, (kind,))
            except (naming.NoSuchThing, naming.SeveralThings) as unfound:
                raise expression.error_at(mention.column, str(unfound)) from None
            facts.ids[mention.kind, mention.text] = found.id

    def _checked(self, end: Offset | None) -> Offset:
        return checked_end(self.reader, end)


def _before(records: Sequence[_Caused], end: Offset) -> list[_Caused]:
    return [record for record in records if record.cause.offset < end]


def _refuse_keyframe(history: History, text: str, end: Offset) -> None:
    """Raise MisuseError if ``text`` is a keyframe: alone it has no explanation."""
    keyframe = names.keyframe_ordinal(history, text)
    if keyframe is None:
        return
    place = names.id_of_place(history, history.place_at(keyframe, end))
    raise MisuseError(
        f"{text} is a keyframe, in {place or 'no place'}; give a place, an object or two keyframes"
    )
