"""Which files the first events of a log are in: what is folded from them can be kept beside the log
and believed later, unless those files have changed since.

In the life of a log, a segment gets sealed and new ones begin behind it. That a sealed segment is
another one than it was, that one is gone, or that one begins where none did, comes from rot and
recovery, deletion, or a power cut that took unsynced events.
"""

import os
from collections.abc import Sequence
from pathlib import Path

from ._naming import SegmentPath, list_growing

_FOOTER_BYTES = 12
"""The end of a sealed segment: the CRC of its summary, which tells of every chunk, and a magic."""

_SEALED = " sealed "


def lineage(log: Path, next_offset: int) -> tuple[str, ...]:
    """One text for each segment with events before ``next_offset``. Raises OSError."""
    return tuple(_of(segment) for segment in list_growing(log) if segment.base < next_offset)


def still_holds(before: Sequence[str], now: Sequence[str]) -> bool:
    """Whether a log whose lineage was ``before`` has, for the same offset, come to ``now`` by
    nothing but sealing."""
    return len(before) == len(now) and all(
        new == old or (_SEALED not in old and new.startswith(old + _SEALED))
        for old, new in zip(before, now, strict=True)
    )


def _of(segment: SegmentPath) -> str:
    """The base alone while it grows; sealed, with size and the checksum at its end."""
    if not segment.sealed:
        return str(segment.base)
    with segment.path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        end = os.pread(file.fileno(), _FOOTER_BYTES, max(0, size - _FOOTER_BYTES))
    return f"{segment.base}{_SEALED}{size} {end.hex()}"
