"""A fold of a growing log, with its view and the changes of each batch of events."""

from collections.abc import Collection, Iterable, Iterator, Sequence

from eventsrc.envelope.model import Offset
from eventsrc.log import Event, LogReader
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.map_errors import FoldError, FoldInterrupted
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.changes import ChangeTracker
from projections.map.fold import fold_events, fold_parsed, with_vectors
from projections.map.parsing import READ_AHEAD, ParsedEvent
from projections.map.view import MapView
from projections.store.tables import TableWriter


class LiveFold:
    """The fold's state, its view without embeddings, and the tracker of the view's changes.

    The fold sets ``next_offset`` and ``corrections`` before it changes, the view after it has. So
    they differ once an exception has come in between, and every later call raises FoldInterrupted.
    """

    def __init__(
        self,
        settings: Settings,
        start: tuple[SemanticMap, MapView] | None = None,
        *,
        corrections: Corrections = NO_CORRECTIONS,
        reader: LogReader | None = None,
        writer: TableWriter | None = None,
    ) -> None:
        """``start`` is a fold that was kept and its view; by default nothing is folded yet.
        ``writer`` is given the deltas of events that are fed, none skipped, from its end on.
        ``reader`` reads the log that is folded, which may have vectors of the map's space beside
        those in envelopes. Raises FoldError, LogDamaged."""
        self.map, self.view = start or (
            SemanticMap(settings, corrections=corrections),
            MapView(settings, keep_embeddings=False, corrections=corrections),
        )
        if reader is not None:
            with_vectors(self.map, reader)
        self.tracker = ChangeTracker(self.view)
        self.writer = writer

    def feed(self, events: Sequence[Event]) -> Iterator[FoldError | None]:
        """Fold events in order, a step for each: None, or why it failed.

        After a failed event the map is as it was before it; the next step passes over the event.
        Events are read a stretch ahead, which is faster than one by one.
        """
        self._check_whole()
        start = 0
        while start < len(events):
            waiting = iter(events[start:])
            try:
                for folded in fold_events(events[start:], self.map, ahead=READ_AHEAD):
                    event = next(waiting)
                    self.tracker.apply_event(event.offset, folded.deltas, event.logged_ns)
                    if self.writer is not None and event.offset >= self.writer.end:
                        self.writer.add(event.offset, folded.deltas)
                    start += 1
                    yield None
            except FoldError as error:
                yield error
                self.skip(events[start].offset)
                start += 1

    def fold_parsed(self, events: Sequence[ParsedEvent]) -> None:
        """Fold events that are parsed. Raises FoldError at the first one that fails."""
        self._check_whole()
        for event in events:
            self.tracker.apply_event(event.offset, fold_parsed(event, self.map), event.logged_ns)

    def use_names(self, offset: Offset, corrections: Corrections) -> None:
        """Apply the names of ``corrections``; the event at ``offset`` changed nothing else in them.
        The event must have been fed or skipped. Raises ValueError."""
        self._check_whole()
        self.writer = None  # what follows is of other corrections
        self.tracker.apply_names(self.map.use_names(offset, corrections))
        self.view.corrections = corrections

    def skip(self, offset: Offset) -> None:
        """Pass over an event that is left out."""
        self._check_whole()
        self.writer = None
        self.map.skip(offset)
        self.view.advance(Offset(offset + 1))

    def _check_whole(self) -> None:
        fold, view = self.map, self.view
        if fold.next_offset != view.next_offset or fold.corrections is not view.corrections:
            raise FoldInterrupted(fold.next_offset)


def batches(
    events: Iterable[Event | None], size: int, cuts: Collection[int] = ()
) -> Iterator[list[Event]]:
    """Group events: a batch ends at ``size``, before an offset in ``cuts``, and at a None.

    A None marks a pause in the events; the batch is empty if no event preceded it.
    """
    batch: list[Event] = []
    for event in events:
        if event is not None:
            if batch and event.offset in cuts:
                yield batch
                batch = []
            batch.append(event)
        if event is None or len(batch) == size:
            yield batch
            batch = []
    if batch:
        yield batch
