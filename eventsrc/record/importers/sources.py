"""Sources of messages to import: what they give, which topics are taken; MCAP files, other logs."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import translate
from pathlib import Path
from typing import BinaryIO, Final, Protocol

from pydantic_core import from_json

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.envelope.cdr_grids import GRID_SCHEMA
from eventsrc.envelope.system_events import Excerpt
from eventsrc.log import LogReader, MessageFormat, VerbatimEvent
from eventsrc.log.foreign_mcap import ForeignDamage, foreign_messages
from eventsrc.log.format import IMPORTED


@dataclass(frozen=True, slots=True)
class ImportedMessage:
    """A message of a source. ``key``, ``logged_ns`` and ``stamp_ns`` are None if it has none.

    ``payload`` is one JSON envelope (`eventsrc.envelope.model`; limits: docs/recording.md);
    any other payload is kept as rejected. ``logged_ns`` is when the source received it.
    ``stamp_ns`` is used for system events of another mapfold log only: the event of an envelope is
    stamped with the envelope's own time. ``version`` is the envelope version that another mapfold
    log has it in; None if there is none. ``form`` is the format of a verbatim message of another
    mapfold log, which is kept as it is, on topic ``key``. ``is_foreign`` marks a message that may
    belong to another program: if it does not look like an envelope, it is passed over. ``unread``
    is the format of a message that no importer reads; it is passed over, and its payload may be
    left out. ``refused`` is the reason if the source could not read the message: it is kept as
    rejected; of a payload that is too large ``excerpt`` is kept. ``begins`` marks the begin of an
    import in another mapfold log, from which log times may be older than before. ``is_grid``
    marks an occupancy grid in CDR, by its type.
    """

    payload: bytes
    key: str | None = None
    logged_ns: int | None = None
    stamp_ns: int | None = None
    version: int | None = None
    form: MessageFormat | None = None
    is_foreign: bool = False
    unread: str | None = None
    refused: str | None = None
    begins: bool = False
    excerpt: Excerpt | None = None
    is_grid: bool = False


class Source(Protocol):
    """A file, stream or log to import from."""

    name: str
    unit: str
    """The unit that `at` counts: ``line``, ``message`` or ``offset``."""
    at: int | None
    """Number of the message that `messages` yielded last."""
    size_bytes: int | None
    skipped: int
    """Number of messages not yielded because their format is not read."""

    def messages(self) -> Iterator[ImportedMessage]:
        """The messages in order."""

    def bytes_read(self) -> int:
        """Bytes read so far, of ``size_bytes``."""


NOT_CHOSEN: Final = "not chosen"
NO_ENVELOPES: Final = "json, no envelopes"
_FIELDS: Final = ("run_id", "keyframe_id", "timestamp", "detections")
_ENOUGH_FIELDS: Final = 2
_CLASS_FIELDS: Final = ("class", "class_name")


@dataclass(frozen=True)
class TopicChoice:
    """The topics that match one of the shell patterns ``patterns``; all topics if there is none.
    ``*`` matches any characters, also ``/``."""

    patterns: tuple[str, ...] = ()
    _expressions: list[re.Pattern[str]] = field(default_factory=list, compare=False)

    @classmethod
    def of(cls, patterns: Sequence[str]) -> "TopicChoice":
        """The choice by these patterns. Raises MisuseError for an empty one."""
        if not all(patterns):
            raise MisuseError("--topic is empty; give a topic, or a pattern such as 'tb/*'")
        return cls(tuple(patterns), [re.compile(translate(pattern)) for pattern in patterns])

    def __bool__(self) -> bool:
        return bool(self.patterns)

    def takes(self, topic: str) -> bool:
        """Whether messages of ``topic`` are imported."""
        return not self._expressions or any(e.match(topic) for e in self._expressions)


@dataclass(frozen=True, slots=True)
class PassedOver:
    """The number of messages of one topic that were not imported. ``what`` is their encoding and
    schema, `NO_ENVELOPES` or `NOT_CHOSEN`."""

    topic: str
    what: str
    count: int


def looks_like_envelope(payload: bytes) -> bool:
    """Whether an invalid payload has enough fields of an envelope to be kept as rejected. True also
    for text that is no JSON, because it may be a torn envelope."""
    try:
        value = from_json(payload)
    except (ValueError, RecursionError):
        return True
    if isinstance(value, dict):
        return sum(name in value for name in _FIELDS) >= _ENOUGH_FIELDS
    if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
        return False
    return all(any(name in each for name in _CLASS_FIELDS) for each in value)


MCAP_MAGIC = b"\x89MCAP0\r\n"


class McapFile:
    """An MCAP file that is no bag of ROS 2. Messages that are neither ``json`` nor occupancy grids
    in ``cdr`` (images, other messages) are passed over."""

    def __init__(self, name: str, file: BinaryIO, size_bytes: int | None) -> None:
        self.name = name
        self.unit = "message"
        self.at: int | None = None
        self.size_bytes = size_bytes
        self.skipped = 0
        self._file = file
        self._read = 0

    def bytes_read(self) -> int:
        """Bytes of the file read."""
        return self._file.tell() if self.size_bytes else self._read

    def messages(self) -> Iterator[ImportedMessage]:
        """The messages in file order."""
        try:
            for number, message in enumerate(foreign_messages(self._file), start=1):
                self.at = number
                excerpt = message.payload if isinstance(message.payload, Excerpt) else None
                payload = (
                    message.payload if isinstance(message.payload, bytes) else message.payload.start
                )
                self._read += len(payload) if excerpt is None else excerpt.size
                is_grid = message.encoding == "cdr" and message.schema == GRID_SCHEMA
                is_read = is_grid or message.encoding == "json"
                if excerpt is not None and (is_read or message.verbatim is not None):
                    yield ImportedMessage(
                        payload,
                        message.key,
                        message.logged_ns,
                        is_foreign=message.encoding == "json" and message.version is None,
                        refused=excerpt.reason(),
                        excerpt=excerpt,
                    )
                elif message.verbatim is not None:
                    yield ImportedMessage(
                        payload,
                        message.key,
                        message.logged_ns,
                        message.published_ns,
                        form=message.verbatim,
                    )
                elif is_read:
                    yield ImportedMessage(
                        payload,
                        message.key,
                        message.logged_ns,
                        message.published_ns,
                        message.version,
                        is_foreign=message.version is None,
                        is_grid=is_grid,
                    )
                else:
                    what = f"{message.encoding} {message.schema}".strip()
                    yield ImportedMessage(b"", message.key, message.logged_ns, unread=what)
        except ForeignDamage as error:
            raise MapfoldError(
                f"{self.name}: {error}; the messages before it are in the log"
            ) from None


class OtherLog:
    """Another mapfold log, from its first event to its last durable one."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self.unit = "offset"
        self.at: int | None = None
        self._reader = LogReader(path)
        self.size_bytes: int | None = None
        self.skipped = 0
        self._read = 0

    def bytes_read(self) -> int:
        """Bytes of payloads read so far."""
        return self._read

    def messages(self) -> Iterator[ImportedMessage]:
        """The log's events, system events included."""
        with self._reader as reader:
            begun = {
                entry.base
                for entry in reader.segments
                if IMPORTED in reader.open_segment(entry).head
            }
            for event in reader.read():
                self.at = event.offset
                self._read += len(event.payload)
                form = event.format if isinstance(event, VerbatimEvent) else None
                times = event.logged_ns, event.stamp_ns
                yield ImportedMessage(
                    event.payload,
                    event.key,
                    *times,
                    event.version,
                    form,
                    begins=event.offset in begun,
                )
