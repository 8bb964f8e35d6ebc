"""The interface that an importer implements: a source of messages."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from eventsrc.envelope.system_events import Excerpt
from eventsrc.log import MessageFormat


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
