"""Watching what `mapfold log cat` shows, for what its reader might wonder about.

A range by times is one of offsets: from the first event stamped then or later to the last one
stamped then or earlier. Where stamps run backwards in between (runs of last year imported after
this year's), events of other times lie inside. And a key that no event has shows nothing.
"""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from eventsrc.errors import LogError
from eventsrc.log import Event
from eventsrc.log.whence import time_of
from eventsrc.log_info import log_info
from eventsrc.system_events import is_system_key
from eventsrc.terminal import visible
from eventsrc.words import counted


class Watch:
    """Over the events of a range that ``--from`` and ``--to`` name, of ``keys`` if any."""

    def __init__(self, first: str, last: str, keys: Sequence[str]) -> None:
        self._first_ns, self._last_ns = time_of(first), time_of(last)
        self._times = " or ".join(
            f"{side} {text}"
            for side, text, time_ns in (
                ("before", first, self._first_ns),
                ("after", last, self._last_ns),
            )
            if time_ns is not None
        )
        self._missing = dict.fromkeys(keys)
        self._outside = 0

    def over(self, events: Iterable[Event]) -> Iterable[Event]:
        """The same events."""
        return self._watched(events) if self._times or self._missing else events

    def _watched(self, events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            self._missing.pop(event.key, None)
            if not is_system_key(event.key):  # ours are stamped when we wrote them
                self._outside += self._is_outside(event.stamp_ns)
            yield event

    def _is_outside(self, stamp_ns: int) -> bool:
        early = self._first_ns is not None and stamp_ns < self._first_ns
        return early or (self._last_ns is not None and stamp_ns > self._last_ns)

    def told(self, log: Path) -> Iterator[str]:
        """Lines for people, once all events have gone by."""
        if self._outside:
            verb = "is" if self._outside == 1 else "are"
            yield (
                f"{log}: {counted(self._outside, 'event')} of these {verb} stamped {self._times}: "
                "stamps run backwards in this log; offsets or RUN:KEYFRAME say what you mean"
            )
        if self._missing:
            yield from self._missing_keys(log)

    def _missing_keys(self, log: Path) -> Iterator[str]:
        with contextlib.suppress(LogError):  # a damaged log: what can be read has been shown
            there = log_info(log).keys
            for key in self._missing:
                if key not in there:
                    names = ", ".join(map(visible, there)) or "none, as the log is empty"
                    yield f"{log}: no event has the key {key!r}; there are {names}"
