"""One message as some other tool kept it, on its way into a log."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Imported:
    """``key`` is None where the source names none. ``logged_ns`` is when the source received the
    message and ``stamp_ns`` when it was published, None where it does not say."""

    payload: bytes
    key: str | None = None
    logged_ns: int | None = None
    stamp_ns: int | None = None


class Source(Protocol):
    """Something to import from."""

    name: str
    unit: str
    """What `at` counts: ``line``, ``message``, ``offset``."""
    at: int | None
    """Where the message that `records` gave last stands."""
    size_bytes: int | None
    skipped: int
    """Messages passed over because they are no JSON by their own declaration."""

    def records(self) -> Iterator[Imported]:
        """The messages in their order."""

    def position(self) -> int:
        """Bytes consumed so far, of ``size_bytes``."""
