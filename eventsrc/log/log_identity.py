"""Which log segments are of, whether they are still the same, and where what is folded is kept.

Log id: a segment copied from another log has a valid name and valid checksums. A reader stops at it
and a writer does not start. Recovery keeps those of one log, chosen by `own_log_id`, and sets the
others aside.

Signatures: what is folded from a log (its gap ledger, its history) is kept with the
signatures of the segments it was folded from, and used only while these are the same. A growing
segment may be sealed and new ones may be added behind; any other change means that events were lost
(deletion, recovery, a power cut before a sync, a log put back from a copy and recorded on).

Caches: the folder ``<log>.history`` beside a log is not part of it and safe to delete at any time.
It holds the log's data, so its permissions are at most those of the log.
"""

import contextlib
import os
import threading
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from eventsrc.base.errors import LogDamaged, LogError, NotALog
from eventsrc.base.machine import system_clock
from eventsrc.base.text import advised
from eventsrc.envelope.model import Offset

from .format import BEGUN, HEAD_BYTES, SegmentPath, WrongPlace, head_of, list_growing, read_head


def common_log_id(segments: Iterable[SegmentPath]) -> str | None:
    """The log id in the readable heads of ``segments``, None if none is readable. Raises LogDamaged
    for two different ids, and for a segment under the name of another."""
    found: tuple[Path, str] | None = None
    for segment in segments:
        try:
            log_id = head_of(segment.path, segment.base)["log_id"]
        except WrongPlace:
            raise
        except (LogDamaged, NotALog):
            continue
        if found is not None and log_id != found[1]:
            raise LogDamaged(mixed_logs_message(segment.path, log_id, *found))
        found = found or (segment.path, log_id)
    return None if found is None else found[1]


class CarriedId(NamedTuple):
    """The log id and base in the head of a file, and whether the file has the name of that base."""

    log_id: str
    base: Offset
    rightly_named: bool


def own_log_id(carried: Iterable[CarriedId], noted: str | None) -> str | None:
    """The log id of a log whose files carry several: that which most of them carry; of equally
    common ones ``noted``, by `sealed_end`, else that of more files under their right names, else
    that whose first segment begins first. None if there is none."""
    by_id: defaultdict[str, list[CarriedId]] = defaultdict(list)
    for each in carried:
        by_id[each.log_id].append(each)

    def rank(log_id: str) -> tuple[int, bool, int, int, str]:
        files = by_id[log_id]
        rightly_named = sum(file.rightly_named for file in files)
        first = min(file.base for file in files)
        return len(files), log_id == noted, rightly_named, -first, log_id

    return max(by_id, key=rank, default=None)


def mixed_logs_message(one: Path, log_id: str, other: Path, other_id: str) -> str:
    """The error text for two segments of different logs."""
    return (
        f"{one} belongs to log {log_id}, but {other.name} to log {other_id}; put the right file in "
        f"place of the wrong one, or run `{advised('log', 'recover', one.parent)}`, which sets the "
        "segments of the other log aside"
    )


_FOOTER_BYTES = 12
"""The end of a sealed segment: the CRC of its summary, which lists every chunk, and the magic."""

_SEALED = " sealed "
_BEGUN: Final = " begun "


def segment_signatures(log: Path, next_offset: Offset) -> tuple[str, ...]:
    """The signature of each segment with events before ``next_offset``. Raises OSError."""
    with contextlib.suppress(FileNotFoundError):  # the growing one was sealed meanwhile
        return _signatures(log, next_offset)
    return _signatures(log, next_offset)


def _signatures(log: Path, next_offset: Offset) -> tuple[str, ...]:
    return tuple(_signature(segment) for segment in list_growing(log) if segment.base < next_offset)


def same_but_sealed(before: Sequence[str], now: Sequence[str]) -> bool:
    """Whether `segment_signatures` for the same offset went from ``before`` to ``now`` by sealing
    alone."""
    return len(before) == len(now) and all(map(_is_same_but_sealed, before, now))


def _is_same_but_sealed(old: str, new: str) -> bool:
    was, _, was_begun = old.partition(_BEGUN)
    now, _, now_begun = new.partition(_BEGUN)
    if was_begun != now_begun:
        return False
    return now == was or (_SEALED not in was and now.startswith(was + _SEALED))


def _signature(segment: SegmentPath) -> str:
    """The base of a growing segment; for a sealed one also its size and the checksum at its end.
    Both include the time at which the segment was started: one recorded again has the same
    base."""
    with segment.path.open("rb") as file:
        try:
            head = read_head(segment.path, file.read(HEAD_BYTES), segment.base)[0]
        except LogError:  # reported when its events are read
            head = {}
        about = str(segment.base)
        if segment.sealed:
            size = os.fstat(file.fileno()).st_size
            end = os.pread(file.fileno(), _FOOTER_BYTES, max(0, size - _FOOTER_BYTES))
            about += f"{_SEALED}{size} {end.hex()}"
    return f"{about}{_BEGUN}{head[BEGUN]}" if BEGUN in head else about


_OWNER: Final = 0o700
_OTHERS: Final = 0o077
_UNFINISHED: Final = ".new"
_LEFT_OVER_S: Final = 3_600.0


def cache_folder(log: Path) -> Path:
    """The path of the folder, which may not exist. For a log given as ``.`` or ``..`` it is
    beside the folder that these name."""
    named = log.resolve() if log.name in ("", "..") else log
    return named.parent / f"{named.name}.history"


def make_cache_folder(log: Path) -> Path:
    """Create `cache_folder` if it does not exist, with no more permissions for group and others
    than the log has; return its path. Raises OSError."""
    folder = cache_folder(log)
    folder.mkdir(mode=_OWNER | (log.stat().st_mode & _OTHERS), exist_ok=True)
    return folder


def write_cache_file(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file under another name and rename it, so that other threads and processes see all
    of it or nothing. Raises OSError and what ``write`` raises; then nothing is left behind."""
    beside = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}{_UNFINISHED}")
    try:
        beside.unlink(missing_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        with os.fdopen(os.open(beside, flags, 0o644), "wb") as file:
            write(file)
        beside.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        raise


def delete_left_over_files(folder: Path) -> None:
    """Delete what killed processes have left of `write_cache_file`. Raises OSError."""
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another process did
            age_s = system_clock() / 1e9 - path.lstat().st_mtime
            if path.name.endswith(_UNFINISHED) and age_s > _LEFT_OVER_S:
                path.unlink()


STANDS_FOR: Final = ".away"
"""Ends the name of the file that says of which archived object another one is made."""


class FileSpan(NamedTuple):
    """The byte at which a span of a cached file begins, which is archived by itself, and the bytes
    of one of its numbers."""

    start: int
    number_bytes: int = 1


def cache_sizes(log: Path) -> list[tuple[Path, int]]:
    """The folder with the total size of its files in bytes, if it exists and can be read."""
    folder = cache_folder(log)
    with contextlib.suppress(OSError):
        return [(folder, sum(map(_size, folder.iterdir())))]
    return []


def _size(path: Path) -> int:
    with contextlib.suppress(FileNotFoundError):  # another process replaced it
        return path.lstat().st_size
    return 0
