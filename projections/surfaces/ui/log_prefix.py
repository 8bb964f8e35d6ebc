"""A reader of the first events of a log, up to where it can be read and folded."""

import sys
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader, Unreadable
from eventsrc.log.reader import OnGap

_NO_LIMIT = Offset(sys.maxsize)
_ASK_EVERY = 500


class PrefixReader(LogReader):
    """A `LogReader` that takes a log to end at ``limit``, if it has as many events.

    Nothing beyond the limit is read, so damage there is no error. ``go_on`` is called regularly
    while events are read; an exception from it ends the reading.
    """

    def __init__(
        self, path: Path, limit: Offset = _NO_LIMIT, go_on: Callable[[], None] = lambda: None
    ) -> None:
        self.limit, self._go_on = limit, go_on
        super().__init__(path)

    @property
    def next_offset(self) -> Offset:
        """The number of events up to the limit."""
        return self.limit if self.is_limited else super().next_offset

    @property
    def readable_end(self) -> Offset:
        """The number of events up to the limit and before those that cannot be read."""
        return min(super().readable_end, self.limit)

    @property
    def is_limited(self) -> bool:
        """Whether the log has events beyond the limit."""
        end = super().readable_end
        return self.limit < end or (self.limit == end and self._unreadable_end is not None)

    def refresh(self) -> Offset:
        """Find what was committed since; the new `next_offset`."""
        if not self.is_limited:
            super().refresh()
        return self.next_offset

    def check_end(self) -> None:
        """As that of a `LogReader`, but segments beyond the limit may be missing."""
        if not self.is_limited:
            super().check_end()

    def read(
        self,
        start: Offset = FIRST_OFFSET,
        end: Offset | None = None,
        *,
        keys: Collection[str] | None = None,
        on_gap: OnGap | None = None,
    ) -> Iterator[Event]:
        """Events from ``start`` to before ``end``, at most to the limit."""
        if self.is_limited:
            end = self.next_offset if end is None else min(end, self.next_offset)
        for number, event in enumerate(super().read(start, end, keys=keys, on_gap=on_gap)):
            if number % _ASK_EVERY == 0:
                self._go_on()
            yield event

    def first_unreadable(self) -> Offset | None:
        """The first offset whose event cannot be read; None if all can. Reads the whole log."""
        found: list[Unreadable] = []
        for _ in super().read(on_gap=found.append):
            if found:
                break
        return found[0].first if found else None
