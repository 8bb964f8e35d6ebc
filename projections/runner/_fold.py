"""One fold that several sinks listen to, each from its own offset on."""

from collections.abc import Iterable, Iterator
from typing import Any

from eventsrc.log import Event
from projections.deltas import Delta
from projections.folding import fold_event
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings
from projections.sink import Sink
from projections.view import MapView


class LiveFold:
    """The fold's state and its view. Embeddings are not kept: sinks get them with the delta."""

    def __init__(self, settings: Settings) -> None:
        self.map = SemanticMap(settings)
        self.view = MapView(settings, keep_embeddings=False)

    def feed(self, event: Event, sinks: Iterable[Sink[Any]]) -> None:
        """Fold one event and tell ``sinks``. Raises FoldError, and has changed nothing then."""
        deltas = fold_event(event, self.map)
        self._apply(event, deltas, list(sinks))

    def skip(self, offset: int) -> None:
        """Pass over an event that is left out."""
        self.map.skip(offset)
        self.view.advance(offset + 1)

    def _apply(self, event: Event, deltas: list[Delta], sinks: list[Sink[Any]]) -> None:
        view = self.view
        for delta in deltas:
            for sink in sinks:
                sink.note(delta, event.logged_ns, view)
            view.apply(delta)
        view.advance(event.offset + 1)


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
