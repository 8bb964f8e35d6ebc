"""How far a log is sealed: ``LOG/.sealed.json``, written after each sealing.

The head of a sealed segment names its end, and the next segment begins there. When the last segment
is deleted, or cut to less than its head, nothing in the segments says what is missing: this file
does. It names the log id, base and end of the last sealed segment, with a CRC as MCAP metadata has.

It says what the log has at least. It may be missing (in copies of the segments alone) or older than
the segments (a crash between the two); one that is damaged, or of another log, is ignored, reported
by `log verify` and replaced by `log recover`. It also tells a log that has lost all its segments
from a folder that is no log (`segments_of`).
"""

import contextlib
import json
import os
import stat
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.base.errors import LogDamaged, LogError, LogNotFound, NotALog
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, Offset

from . import format as names
from . import mcap_records as _mcap
from .durable_files import replace_durably, sync_file, unlink_quietly, write_all
from .mcap_records import Metadata

_MAX_BYTES: Final = 4096


class SealedEnd(NamedTuple):
    """The last sealed segment of a log: offsets ``base`` to before ``following``."""

    log_id: str
    base: Offset
    following: Offset

    def reach(self, base: Offset) -> Offset | None:
        """Where the last segment that a log has, at ``base``, ends at least; None if unknown."""
        if base < self.base:
            return self.base
        return self.following if base == self.base else None

    def missing(self, log: Path, next_offset: Offset) -> str | None:
        """Why a log that ends at ``next_offset`` is damaged; None if nothing is missing."""
        if next_offset >= self.following:
            return None
        name = names.segment_path(log, max(self.base, next_offset), names.SEALED).name
        new_log = "" if next_offset else f"; for a new log delete {log / names.SEALED_END}"
        return (
            f"{log}: offsets {next_offset} to {self.following - 1} were sealed and are not there "
            f"(by {names.SEALED_END}; {name} was deleted or replaced): put the file back, or run "
            f"`{advised('log', 'recover', log)}`, which marks them as lost{new_log}"
        )

    def require(self, log: Path, next_offset: Offset) -> None:
        """Raise LogDamaged for a log that ends at ``next_offset``, before it was sealed to."""
        text = self.missing(log, next_offset)
        if text is not None:
            raise LogDamaged(text)


class InvalidSealedEnd(Exception):
    """Why the file is ignored. Inside ``eventsrc.log`` only."""


def sealed_end(log: Path) -> SealedEnd | None:
    """How far a log was sealed. Beside a writer, call it before listing the segments. None without
    a file that can be used."""
    with contextlib.suppress(InvalidSealedEnd):
        return read_sealed_end(log)
    return None


def sealed_end_of(log: Path, log_id: str | None) -> SealedEnd | None:
    """`sealed_end`, None also if it is of another log than ``log_id``."""
    end = sealed_end(log)
    return end if end is not None and log_id in (None, end.log_id) else None


def read_sealed_end(log: Path) -> SealedEnd | None:
    """How far a log was sealed, None without a file. Raises InvalidSealedEnd."""
    try:
        data = _read(log / names.SEALED_END)
        values = json.loads(data)
        if not (isinstance(values, dict) and all(isinstance(v, str) for v in values.values())):
            raise InvalidSealedEnd("it is no JSON object of texts")
        values = _mcap.checked_metadata(Metadata(names.SEALED_END, values))
        end = SealedEnd(
            values["log_id"],
            names.read_number(values["base"]),
            names.read_number(values["following"]),
        )
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InvalidSealedEnd(error.strerror or str(error)) from error
    except (ValueError, KeyError, RecursionError) as error:
        raise InvalidSealedEnd(f"it is not what mapfold writes: {error}") from None
    if end.base >= end.following:
        raise InvalidSealedEnd("its segment has no event")
    return end


def _read(path: Path) -> bytes:
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_BYTES:
            raise InvalidSealedEnd(f"it is no regular file of at most {_MAX_BYTES:,} bytes")
        return os.read(fd, _MAX_BYTES)
    finally:
        os.close(fd)


def note_sealed(log: Path, end: SealedEnd) -> None:
    """Write that a segment, which is durable, was sealed, unless the file says more. Raises
    OSError."""
    known = sealed_end_of(log, end.log_id)
    if known is None or known.following < end.following:
        write_sealed_end(log, end)


def write_sealed_end(log: Path, end: SealedEnd) -> None:
    """Write the file durably; a folder of its name is set aside. Raises OSError."""
    values = {"log_id": end.log_id, "base": str(end.base), "following": str(end.following)}
    record = _mcap.metadata_with_crc(names.SEALED_END, values)
    final, temporary = log / names.SEALED_END, log / f"{names.SEALED_END}.new"
    if final.is_dir() and not final.is_symlink():
        final.rename(names.free_name(final, names.DAMAGED))
    unlink_quietly(temporary)
    try:
        fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
        try:
            write_all(fd, json.dumps(record.metadata).encode())
            sync_file(fd)
        finally:
            os.close(fd)
        replace_durably(temporary, final)
    except OSError:
        unlink_quietly(temporary)
        raise


def segments_of(path: Path) -> list[names.SegmentPath]:
    """The segments of a log; LogNotFound, NotALog or LogDamaged when there are none, LogError when
    the folder may not be read."""
    try:
        return _segments_of(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise LogError(f"{path}: {reason}; check the folder's rights and its disk") from error


def segments_left(path: Path) -> list[names.SegmentPath]:
    """`segments_of`, and none, instead of LogDamaged, where all of a log are missing."""
    try:
        return segments_of(path)
    except LogDamaged:
        return []


def _segments_of(path: Path) -> list[names.SegmentPath]:
    if not path.exists():
        raise LogNotFound(f"no log at {path}; record or import one, or check the path")
    if not path.is_dir():
        raise NotALog(
            f"{path} is a file; a log is a directory. `{advised('import', 'LOG', path)}` imports it"
        )
    end = sealed_end(path)
    segments = names.list_growing(path)
    if not segments:
        if end is not None:
            end.require(path, FIRST_OFFSET)
        raise NotALog(
            f"{path} holds no log segment (….mcap); check the path, or make a log there:"
            f" `{advised('import', path, 'FILE')}`, or record"
        )
    return segments
