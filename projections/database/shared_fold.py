"""One fold that several sinks listen to, each from its own offset on."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeAlias

from eventsrc.envelope import Offset
from eventsrc.log import Event
from projections.deltas import Delta
from projections.errors import FoldError
from projections.model.fold import AHEAD, fold_events
from projections.model.view import MapView
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings

from .sink import Sink

SinksOf: TypeAlias = Callable[[Event], Sequence[Sink[Any]]]
"""Which sinks an event is for: those that do not have it yet."""


class LiveFold:
    """The fold's state and its view. Embeddings are not kept: sinks get them with the delta."""

    def __init__(
        self, settings: Settings, start: tuple[SemanticMap, MapView] | None = None
    ) -> None:
        """``start`` is a snapshot's, to go on from; by default nothing is folded yet."""
        self.map, self.view = start or (
            SemanticMap(settings),
            MapView(settings, keep_embeddings=False),
        )

    def feed(self, events: Sequence[Event], sinks_of: SinksOf) -> Iterator[FoldError | None]:
        """Fold events in order, telling each one's sinks; a step for each: None, or why it failed.

        After a failed event the map is as it was before it; the event is passed over when the next
        step is asked for. Events are read a stretch ahead, which is faster than one by one.
        """
        start = 0
        while start < len(events):
            waiting = iter(events[start:])
            try:
                for folded in fold_events(events[start:], self.map, ahead=AHEAD):
                    self._apply(next(waiting), folded.deltas, sinks_of)
                    start += 1
                    yield None
            except FoldError as error:
                yield error
                self.skip(events[start].offset)
                start += 1

    def skip(self, offset: Offset) -> None:
        """Pass over an event that is left out."""
        self.map.skip(offset)
        self.view.advance(Offset(offset + 1))

    def _apply(self, event: Event, deltas: list[Delta], sinks_of: SinksOf) -> None:
        for sink in sinks_of(event):
            sink.note(deltas, event.logged_ns, self.view)
        self.view.apply_event(event.offset, deltas)


def batches(events: Iterable[Event | None], size: int) -> Iterator[list[Event]]:
    """Group events: a batch ends at ``size`` or where the stream pauses (None).

    An empty batch says that nothing came for a while.
    """
    batch: list[Event] = []
    for event in events:
        if event is not None:
            batch.append(event)
        if event is None or len(batch) == size:
            yield batch
            batch = []
    if batch:
        yield batch
