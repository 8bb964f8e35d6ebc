"""An event of a log, and an event to be appended.

Most events are JSON: an envelope, or one of mapfold's own. The others are *verbatim messages*:
bytes of other programs (a message of ROS in CDR, a JPEG), kept beside them with a topic, a message
encoding and a schema, so that readers of MCAP show them. No fold reads them.
"""

import hashlib
import json
from typing import NamedTuple

import msgspec

from eventsrc.envelope.model import ENVELOPE_VERSION, Offset
from eventsrc.envelope.system_events import is_system_key


class Event(msgspec.Struct, frozen=True, gc=False):
    """A recorded message.

    ``offset`` is its index in the log, which alone orders events. ``logged_ns`` is when it was
    written, ``stamp_ns`` when the robot says it happened, both int nanoseconds since the Unix
    epoch; either may run backwards. ``payload`` is the message verbatim, in the envelope form of
    ``version`` (see `eventsrc.envelope.forms`).
    """

    offset: Offset
    key: str
    logged_ns: int
    stamp_ns: int
    payload: bytes
    version: int = ENVELOPE_VERSION

    @property
    def is_envelope(self) -> bool:
        """Whether it carries an envelope: it is neither mapfold's own nor a verbatim message."""
        return not is_system_key(self.key)


def event_hash(event: Event | None) -> str:
    """SHA-256 of an event's offset, key, times and payload, in hex; "" for None. The same message
    recorded again has another hash, since it is logged at another time."""
    if event is None:
        return ""
    head = json.dumps([event.offset, event.key, event.logged_ns, event.stamp_ns]).encode()
    return hashlib.sha256(head + b"\n" + event.payload).hexdigest()


class MessageFormat(NamedTuple):
    """The format of a verbatim message: the fields of its MCAP channel and schema.

    ``encoding`` is the message encoding (``cdr``, ``jpeg``). ``schema`` is empty if there is none;
    else its name, such as ``nav_msgs/msg/Odometry``, with the encoding of the schema (``ros2msg``)
    and its text.
    """

    encoding: str
    schema: str = ""
    schema_encoding: str = ""
    schema_text: bytes = b""


class VerbatimEvent(Event, frozen=True, kw_only=True, gc=False):
    """A verbatim message; ``key`` is its topic."""

    format: MessageFormat

    @property
    def is_envelope(self) -> bool:
        """False: a verbatim message is no envelope."""
        return False


class NewEvent(msgspec.Struct, frozen=True, gc=False):
    """An event to be appended; the log gives it an offset."""

    key: str
    payload: bytes
    logged_ns: int
    stamp_ns: int
    version: int = ENVELOPE_VERSION
    format: MessageFormat | None = None
    """The format of a verbatim message; None for JSON."""
