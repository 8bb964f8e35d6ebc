"""What an importer implements: a source of messages."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class ImportedMessage:
    """A message of a source, with what is None if the source does not say: its ``key``,
    ``logged_ns`` (when the source received it) and ``stamp_ns`` (when it was published)."""

    payload: bytes
    key: str | None = None
    logged_ns: int | None = None
    stamp_ns: int | None = None


class Source(Protocol):
    """A file, stream or log to import from."""

    name: str
    unit: str
    """What `at` counts: ``line``, ``message`` or ``offset``."""
    at: int | None
    """Number of the message that `messages` yielded last."""
    size_bytes: int | None
    skipped: int
    """Messages skipped because their channel is not declared as JSON."""

    def messages(self) -> Iterator[ImportedMessage]:
        """The messages in order."""

    def bytes_read(self) -> int:
        """Bytes read so far, of ``size_bytes``."""
