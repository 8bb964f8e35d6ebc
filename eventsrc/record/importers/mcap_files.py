"""Import messages of MCAP files and of other mapfold logs, in file order."""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from eventsrc.base.errors import MapfoldError
from eventsrc.envelope.cdr_grids import GRID_SCHEMA
from eventsrc.envelope.system_events import Excerpt
from eventsrc.log import LogReader, VerbatimEvent
from eventsrc.log.foreign_mcap import ForeignDamage, foreign_messages
from eventsrc.log.format import IMPORTED

from .source import ImportedMessage

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
