"""An event of a log, and an event to be appended."""

from dataclasses import dataclass
from typing import NamedTuple

from eventsrc.envelope import ENVELOPE_VERSION, Offset


@dataclass(frozen=True, slots=True)
class Event:
    """A recorded message.

    ``offset`` is its index in the log, which alone orders events. ``logged_ns`` is when it was
    written, ``stamp_ns`` when the robot says it happened, both int nanoseconds since the Unix
    epoch; either may run backwards. ``payload`` is the message verbatim, in the envelope form of
    ``version`` (see `eventsrc.upcast`).
    """

    offset: Offset
    key: str
    logged_ns: int
    stamp_ns: int
    payload: bytes
    version: int = ENVELOPE_VERSION


class NewEvent(NamedTuple):
    """An event to be appended; the log gives it an offset."""

    key: str
    payload: bytes
    logged_ns: int
    stamp_ns: int
    version: int = ENVELOPE_VERSION
