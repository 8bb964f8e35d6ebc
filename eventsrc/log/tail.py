"""Follow a log as it grows: every event once, across rotations, milliseconds after its commit.

Polls the commit marks of the file: while nothing comes, one `pread` of some 80 bytes and five
`stat` for the next segment every 5 ms. That costs one to two percent of a core (58 to 86 µs a poll,
most of it waking up), needs nothing from the platform, and works across processes.

A chunk damaged before it was read looks like one that is being written. So a waiting tail checks
once a second whether recorded events follow it.
"""

import threading
from collections.abc import Iterator
from pathlib import Path

from eventsrc.envelope.model import Offset

from .event import Event
from .reader import LogReader

POLL_S = 0.005
_CHECK_EVERY = 200
"""Idle polls between two checks: one second."""


def follow(
    path: Path, start: Offset, *, stop: threading.Event, poll_s: float = POLL_S
) -> Iterator[Event | None]:
    """Events from ``start`` on, until ``stop`` is set.

    Yields None after each poll, when every durable event has been yielded, so that the caller can
    finish a batch. Raises LogDamaged where events cannot be read, and LogNotFound when the log is
    gone.
    """
    with LogReader(path) as reader:
        at = start
        idle_polls = 0
        while not stop.is_set():
            end = reader.refresh()
            idle_polls = 0 if at < end else idle_polls + 1
            if idle_polls % _CHECK_EVERY == _CHECK_EVERY - 1:
                reader.check_end()
            for event in reader.read(at, end):
                yield event
                if stop.is_set():
                    return
            at = max(at, end)
            yield None
            stop.wait(poll_s)
