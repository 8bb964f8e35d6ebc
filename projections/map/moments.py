"""Times of a timeline for the events of a log.

The times of a timeline never run backwards. Those of a log may: an older run is imported later, or
a clock is set. So the time of an event here is the latest stamp of the robots' events up to it,
which keeps the order of events. mapfold's own events have the time of the one before.
"""

from bisect import bisect_right
from collections.abc import Iterable
from itertools import accumulate

from eventsrc.envelope.model import Offset
from eventsrc.log import Event, MessageFormat, VerbatimEvent


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
