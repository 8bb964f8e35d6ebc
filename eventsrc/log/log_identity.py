"""Check that all segments carry the same log id.

Somebody copies, restores, mixes up: a segment of another log has the right name, and every checksum
in it holds. A reader stops at it and a writer does not start. Recovery goes by the majority, and
does nothing where there is none.

Which files the first events of a log are in: what is folded from them can be kept beside the log
and believed later, unless those files have changed since.

In the life of a log, a segment gets sealed and new ones begin behind it. That a sealed segment is
another one than it was, that one is gone, or that one begins where none did, comes from rot and
recovery, deletion, or a power cut that took unsynced events.
"""

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from eventsrc.envelope import Offset
from eventsrc.errors import LogDamaged, NotALog

from .format import SegmentPath, WrongPlace, head_of, list_growing


def log_id_of(segments: Iterable[SegmentPath]) -> str | None:
    """The log that ``segments`` belong to, as far as their heads can be read. Raises LogDamaged
    when they name two, and when one has the name of another segment."""
    found: tuple[Path, str] | None = None
    for segment in segments:
        try:
            log_id = head_of(segment.path, segment.base)["log_id"]
        except WrongPlace:
            raise
        except (LogDamaged, NotALog):
            continue
        if found is not None and log_id != found[1]:
            raise LogDamaged(mixed_up(segment.path, log_id, *found))
        found = found or (segment.path, log_id)
    return None if found is None else found[1]


def majority_of(log_ids: Iterable[tuple[Path, str]]) -> str | None:
    """The log id that most of these segments carry. Raises LogDamaged when two ids are carried by
    equally many, for only a person knows then which files are the wrong ones."""
    by_path = dict(log_ids)
    ranked = Counter(by_path.values()).most_common(2)
    if len(ranked) == 2 and ranked[0][1] == ranked[1][1]:
        one, other = ((p, i) for i, _ in ranked for p in [_first(by_path, i)])
        raise LogDamaged(mixed_up(*one, *other))
    return ranked[0][0] if ranked else None


def _first(by_path: dict[Path, str], log_id: str) -> Path:
    return min(path for path, carried in by_path.items() if carried == log_id)


def mixed_up(one: Path, log_id: str, other: Path, other_id: str) -> str:
    """What to say of two segments that are of two logs."""
    return (
        f"{one} belongs to log {log_id}, but {other.name} to log {other_id}; put the right file in "
        f"place of the wrong one, or move that away and run `mapfold log recover {one.parent}`"
    )


_FOOTER_BYTES = 12
"""The end of a sealed segment: the CRC of its summary, which tells of every chunk, and a magic."""

_SEALED = " sealed "


def lineage(log: Path, next_offset: Offset) -> tuple[str, ...]:
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
