"""A log on a timeline: the times of its events, and its fold event by event, with the events after
which a recording shows the whole map.

The times of a timeline never run backwards. Those of a log may: an older run is imported later, or
a clock is set. So the time of an event here is the latest stamp of the robots' events up to it,
which keeps the order of events. mapfold's own events have the time of the one before.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from itertools import accumulate
from typing import Final, NamedTuple

from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader, MessageFormat, VerbatimEvent
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.deltas import Delta, PlacesMerged
from projections.fold.settings import Settings

from .fold import fold_event, new_map
from .view import MapView


def format_of(event: Event) -> MessageFormat | None:
    """The format of a verbatim message, None for JSON."""
    return event.format if isinstance(event, VerbatimEvent) else None


class Moments:
    """The times of the events of a log, in ns since the Unix epoch; ``events`` are all of them."""

    def __init__(self, events: Iterable[Event]) -> None:
        topics: dict[tuple[str, MessageFormat | None], None] = {}
        stamps = []
        for event in events:
            topics[event.key, format_of(event)] = None
            is_own = not event.is_envelope
            stamps.append((None if is_own else event.stamp_ns, event.logged_ns))
        self.topics = tuple(topics)
        """Keys and formats of the events, in the order in which they appear."""
        known = [stamp for stamp, _ in stamps if stamp is not None]
        first = known[0] if known else min((logged for _, logged in stamps), default=0)
        given = (first if stamp is None else stamp for stamp, _ in stamps)
        self.times_ns = list(accumulate(given, max))
        self.backwards = sum(
            stamp is not None and stamp < time
            for (stamp, _), time in zip(stamps, self.times_ns, strict=True)
        )
        """Events whose own stamp is earlier than that of an event before them."""

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time; (0, 0) for an empty log."""
        return (self.times_ns[0], self.times_ns[-1]) if self.times_ns else (0, 0)

    def time_of(self, end: Offset) -> int:
        """The time from which the map after ``end`` events is current."""
        return self.times_ns[end - 1] if end else self.span_ns[0]

    def offset_at(self, time_ns: int) -> Offset:
        """The number of events up to a time, those at it included."""
        return Offset(bisect_right(self.times_ns, time_ns))


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
