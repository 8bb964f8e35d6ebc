"""One event as it stands in a log, and as it comes to one."""

from dataclasses import dataclass
from typing import NamedTuple

from eventsrc.envelope import ENVELOPE_VERSION, Offset


@dataclass(frozen=True, slots=True)
class Event:
    """One recorded message.

    ``offset`` is its index in the log and its only order. ``logged_ns`` is when it was written,
    ``stamp_ns`` when the robot says it happened, both int nanoseconds since the Unix epoch; either
    may run backwards. ``payload`` is the message, byte for byte as it came, in the form of the
    envelope's ``version`` (see `eventsrc.upcast`).
    """

    offset: Offset
    key: str
    logged_ns: int
    stamp_ns: int
    payload: bytes
    version: int = ENVELOPE_VERSION


class NewEvent(NamedTuple):
    """What an `Event` is before the log gives it an offset."""

    key: str
    payload: bytes
    logged_ns: int
    stamp_ns: int
    version: int = ENVELOPE_VERSION
