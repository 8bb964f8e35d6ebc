"""A fold event by event, with the events after which a recording shows the whole map."""

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.deltas import Delta, PlacesMerged
from projections.fold.settings import Settings

from .fold import fold_event
from .moments import Moments
from .space_vectors import new_map
from .view import MapView

SCENES: Final = 500
"""The default number of scenes of a recording; each holds the whole map."""


class Step(NamedTuple):
    """A folded event: its time on a timeline (`Moments`), its deltas, and whether a scene is due
    after it."""

    event: Event
    time_ns: int
    deltas: list[Delta]
    is_scene: bool


class RecordedFold:
    """The fold of a log's first ``end`` events. A scene is due after every ``every``-th event,
    after each merge of places and at the end; by default some `SCENES` are."""

    def __init__(
        self,
        reader: LogReader,
        settings: Settings,
        end: Offset,
        *,
        corrections: Corrections = NO_CORRECTIONS,
        every: int | None = None,
        progress: Callable[[int, int], None] = lambda *_: None,
    ) -> None:
        self._reader, self._end, self._progress = reader, end, progress
        self._map = new_map(reader, settings, corrections)
        self._every = every or max(1, -(-end // SCENES))
        self.moments = Moments(reader.read(FIRST_OFFSET, end))
        self.view = MapView(settings, keep_embeddings=False, corrections=corrections)
        """The map of the events yielded so far."""
        self.merges: list[PlacesMerged] = []
        """The merges of places in the events yielded so far."""

    def __iter__(self) -> Iterator[Step]:
        """Raises FoldError at an event that cannot be folded."""
        for event in self._reader.read(FIRST_OFFSET, self._end):
            deltas = fold_event(event, self._map)
            self.view.apply_event(event.offset, deltas)
            new = [delta for delta in deltas if isinstance(delta, PlacesMerged)]
            self.merges += new
            done = self.view.next_offset
            is_scene = bool(new) or done % self._every == 0 or done == self._end
            yield Step(event, self.moments.times_ns[event.offset], deltas, is_scene)
            self._progress(done, self._end)
