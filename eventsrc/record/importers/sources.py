"""Messages to import and what gives them: their topics and log times, MCAP files, other logs; and
which of them a log takes that drops classes."""

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from pydantic import ValidationError
from pydantic_core import from_json

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.envelope.crops import CROP_SCHEMA, InvalidCrop, decode_crop
from eventsrc.envelope.dropped_classes import ClassDropper
from eventsrc.envelope.grid_messages import GRID_SCHEMA
from eventsrc.envelope.model import RunId
from eventsrc.envelope.system_events import (
    EMBEDDINGS_KEY,
    REDACTED_KEY,
    REDACTION_KEY,
    REJECTED_KEY,
    Excerpt,
    InvalidEmbeddings,
    decode_embeddings,
)
from eventsrc.log import LogReader, MessageFormat, VerbatimEvent
from eventsrc.log.foreign_mcap import ForeignDamage, ForeignMessage, foreign_messages
from eventsrc.log.format import IMPORTED
from eventsrc.ros import measured
from eventsrc.ros import messages as ros


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


class Source(ABC):
    """A file, stream or log to import from. An importer defines `messages`, which sets `at`."""

    unit = "message"
    """The unit that `at` counts: ``line``, ``message`` or ``offset``."""

    def __init__(self, name: str, size_bytes: int | None = None) -> None:
        self.name = name
        self.size_bytes = size_bytes
        self.at: int | None = None
        """Number of the message that `messages` yielded last."""
        self.skipped = 0
        """Number of messages not yielded because their format is not read."""
        self._read = 0

    @abstractmethod
    def messages(self) -> Iterator[ImportedMessage]:
        """The messages in order."""

    def bytes_read(self) -> int:
        """Bytes read so far, of ``size_bytes``."""
        return self._read


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

    @classmethod
    def of(cls, patterns: Sequence[str]) -> "TopicChoice":
        """The choice by these patterns. Raises MisuseError for an empty one."""
        if not all(patterns):
            raise MisuseError("--topic is empty; give a topic, or a pattern such as 'tb/*'")
        return cls(tuple(patterns))

    def __bool__(self) -> bool:
        return bool(self.patterns)

    def takes(self, topic: str) -> bool:
        """Whether messages of ``topic`` are imported."""
        return not self.patterns or any(fnmatchcase(topic, each) for each in self.patterns)


@dataclass(frozen=True, slots=True)
class PassedOver:
    """The number of messages of one topic that were not imported. ``what`` is their encoding and
    schema, or a reason such as `NOT_CHOSEN`."""

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


_MAY_SHOW: Final = "may show what the log drops"
_OF_ITS_OWN_LOG: Final = "about its own log"
SHOW_NOTHING: Final = (
    *(ros.TF, ros.ODOMETRY, ros.POSE, ros.CAMERA_INFO, ros.GRID),
    *(ros.LABELS, ros.VISION_INFO, ros.PARAMETERS, measured.LASER_SCAN),
)
"""Types of messages of ROS that show no detection."""


def not_dropped(
    message: ImportedMessage, dropper: ClassDropper[ImportedMessage]
) -> list[ImportedMessage]:
    """What a log that drops classes takes of a message that is no envelope: nothing of a crop while
    its envelope has not come, other messages without what they show."""
    form = message.form
    if form is not None and form.schema == CROP_SCHEMA:
        try:
            det_id = decode_crop(message.payload).det_id
        except InvalidCrop:  # another picture
            return [replace(message, form=None, unread=f"{form.schema}, {_MAY_SHOW}")]
        return dropper.crop(det_id, message, len(message.payload))
    if form is not None and form.schema not in SHOW_NOTHING:
        what = f"{form.encoding} {form.schema}".strip()
        return [replace(message, form=None, unread=f"{what}, {_MAY_SHOW}")]
    try:
        if message.key == REJECTED_KEY:
            return [replace(message, payload=dropper.refused_again(message.payload))]
        if message.key == EMBEDDINGS_KEY:
            return _embeddings(message, dropper)
    except (InvalidEmbeddings, ValidationError):
        return [replace(message, unread=f"an event that cannot be read, {_MAY_SHOW}")]
    return [message]


def _embeddings(
    message: ImportedMessage, dropper: ClassDropper[ImportedMessage]
) -> list[ImportedMessage]:
    made = decode_embeddings(message.payload)
    left = [i for i, det_id in enumerate(made.det_ids) if not dropper.knows_dropped(det_id)]
    if len(left) == len(made.det_ids):
        return [message]
    kept = made._replace(
        det_ids=tuple(made.det_ids[i] for i in left), vectors=made.vectors[np.array(left, int)]
    )
    return [replace(message, payload=kept.encode())] if left else []


TOGETHER_NS: Final = 10 * 1_000_000_000
"""A run whose first stamp is at most this long before the last log time counts as simultaneous."""
CLOCK_SET_NS: Final = 24 * 3600 * 1_000_000_000
"""A keyframe stamped longer than this before its run's latest log time means that the robot's clock
was set back."""


class LogTimes:
    """The log times of messages, in the order in which they are appended; int nanoseconds.

    A viewer plays a log by its log times. So an imported envelope has its stamp as its log time,
    and a drive of eight minutes plays eight minutes; the time of the import is in the segment's
    metadata. Log times imitate times of receipt. They do not go back for a keyframe that was sent
    late, or where the clocks of two robots differ a little. They go back where an older drive
    follows, and where a robot's clock was set back. Each takes logarithmic time, whatever the
    number of runs.
    """

    def __init__(self) -> None:
        self._count = 0
        self._starts: dict[RunId, int] = {}
        """The number of the first message of each run, or of the first since its clock was set."""
        self._numbers: list[int] = []
        self._peaks: list[int] = []
        """The log times that are higher than those of all later messages, so in falling order;
        ``_numbers`` are the numbers of their messages."""
        self.last_ns: int | None = None

    def add(self, logged_ns: int) -> int:
        """Add a message with the log time ``logged_ns``, which is returned."""
        while self._peaks and self._peaks[-1] <= logged_ns:
            self._peaks.pop()
            self._numbers.pop()
        self._peaks.append(logged_ns)
        self._numbers.append(self._count)
        self._count += 1
        self.last_ns = logged_ns
        return logged_ns

    def add_stamped(self, run_id: RunId, stamp_ns: int) -> int:
        """Add a keyframe of a run by its stamp; return its log time."""
        start = self._starts.get(run_id)
        if start is None:
            together = self.last_ns is not None and 0 <= self.last_ns - stamp_ns <= TOGETHER_NS
            latest_ns = self.last_ns if together else None
        else:
            latest_ns = self._peaks[bisect_left(self._numbers, start)]
            if latest_ns - stamp_ns > CLOCK_SET_NS:
                start = latest_ns = None
        if start is None:
            self._starts[run_id] = self._count
        return self.add(stamp_ns if latest_ns is None else max(stamp_ns, latest_ns))


class McapFile(Source):
    """An MCAP file that is no bag of ROS 2. Messages that are neither ``json`` nor occupancy grids
    in ``cdr`` (images, other messages) are passed over."""

    def __init__(self, name: str, file: BinaryIO, size_bytes: int | None) -> None:
        super().__init__(name, size_bytes)
        self._file = file

    def bytes_read(self) -> int:
        """Bytes of the file read."""
        return self._file.tell() if self.size_bytes else self._read

    def messages(self) -> Iterator[ImportedMessage]:
        """The messages in file order."""
        try:
            for self.at, message in enumerate(foreign_messages(self._file), start=1):  # noqa: B020
                yield self._imported(message)
        except ForeignDamage as error:
            raise MapfoldError(
                f"{self.name}: {error}; the messages before it are in the log"
            ) from None

    def _imported(self, message: ForeignMessage) -> ImportedMessage:
        excerpt = message.payload if isinstance(message.payload, Excerpt) else None
        payload = message.payload.start if isinstance(message.payload, Excerpt) else message.payload
        self._read += len(payload) if excerpt is None else excerpt.size
        is_json = message.encoding == "json"
        is_grid = message.encoding == "cdr" and message.schema == GRID_SCHEMA
        if not (is_json or is_grid or message.verbatim is not None):
            what = f"{message.encoding} {message.schema}".strip()
            return ImportedMessage(b"", message.key, message.logged_ns, unread=what)
        return ImportedMessage(
            payload,
            message.key,
            message.logged_ns,
            message.published_ns,
            message.version,
            message.verbatim,
            is_foreign=message.version is None and (is_json or excerpt is None),
            refused=None if excerpt is None else excerpt.reason(),
            excerpt=excerpt,
            is_grid=is_grid,
        )


class OtherLog(Source):
    """Another mapfold log, from its first event to its last durable one, system events included."""

    unit = "offset"

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._reader = LogReader(path)

    def messages(self) -> Iterator[ImportedMessage]:
        """The log's events."""
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
                about = event.logged_ns, event.stamp_ns, event.version, form
                begins = event.offset in begun
                own = _OF_ITS_OWN_LOG if event.key in (REDACTION_KEY, REDACTED_KEY) else None
                yield ImportedMessage(event.payload, event.key, *about, begins=begins, unread=own)
