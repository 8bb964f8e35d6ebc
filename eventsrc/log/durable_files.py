"""When events reach the disk for good, and the calls that put them there.

``always``   every event is synced before `append` returns
``<N>ms``    group commit: events are written and synced together every N milliseconds, or sooner
             when 256 events or 4 MiB wait (``50ms`` is the default)
``never``    written every 50 ms and left to the operating system: survives kill -9, not a power cut

The bytes of a file that may be huge, full of holes, or on a disk that is failing.

Read in blocks, and as much of them as is asked for, so that memory does not grow with the file. The
holes of a sparse file are passed over when it is searched. Not mapped: a bad sector under a mapping
kills the process.
"""

import contextlib
import errno
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from eventsrc.errors import MisuseError

GROUP_EVENTS = 256
GROUP_BYTES = 4 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class FsyncPolicy:
    """How many events, bytes and nanoseconds may wait for a commit, and whether it syncs."""

    interval_ns: int
    max_events: int = GROUP_EVENTS
    max_bytes: int = GROUP_BYTES
    syncs: bool = True


ALWAYS = FsyncPolicy(interval_ns=0, max_events=1)
GROUP_COMMIT = FsyncPolicy(interval_ns=50_000_000)
NEVER = FsyncPolicy(interval_ns=50_000_000, syncs=False)


def parse_fsync(text: str) -> FsyncPolicy:
    """``always``, ``never`` or a time such as ``50ms``."""
    if text == "always":
        return ALWAYS
    if text == "never":
        return NEVER
    match = re.fullmatch(r"(\d{1,6})ms", text)
    if match is None or int(match[1]) == 0:
        raise MisuseError(f"--fsync {text!r} is none of always, never or <N>ms; try --fsync 50ms")
    return FsyncPolicy(interval_ns=int(match[1]) * 1_000_000)


def sync_file(fd: int) -> None:
    """Bytes and size of an open file to stable storage. The size is part of fdatasync's promise."""
    getattr(os, "fdatasync", os.fsync)(fd)


def sync_directory(path: Path) -> None:
    """Make a created, renamed or deleted name in ``path`` survive a power cut."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def make_directory_durably(path: Path) -> None:
    """Make ``path``, and what it stands in, so that a power cut takes none of them. One that is
    there already may have been made a moment before a power cut: its name is synced all the same.
    """
    if not path.parent.exists():
        make_directory_durably(path.parent)
    path.mkdir(exist_ok=True)
    with contextlib.suppress(PermissionError):  # it stands in a folder that is not for us to read
        sync_directory(path.parent)


def write_all(fd: int, data: bytes) -> None:
    """Write every byte; the system may take fewer at a time."""
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]


def replace_durably(temporary: Path, final: Path) -> None:
    """Rename a synced file to its name and sync the name."""
    temporary.replace(final)
    sync_directory(final.parent)


def keep_copy(path: Path, copy: Path) -> None:
    """Give a file a second name, or where its file system knows none (exFAT), copy and sync it.
    Raises FileExistsError when the name is taken."""
    try:
        copy.hardlink_to(path)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK):
            raise
        _copy_durably(path, copy)


def _copy_durably(path: Path, copy: Path) -> None:
    with path.open("rb") as source, copy.open("xb") as target:
        try:
            shutil.copyfileobj(source, target)
            target.flush()
            sync_file(target.fileno())
        except OSError:
            copy.unlink()
            raise


def delete_durably(path: Path) -> None:
    """Delete a file if it is there, so that not even a power cut brings it back. Raises OSError."""
    unlink_quietly(path)
    sync_directory(path.parent)


def unlink_quietly(path: Path) -> None:
    """Remove ``path`` if it is there."""
    with contextlib.suppress(FileNotFoundError):
        path.unlink()


_BLOCK = 1024 * 1024
_SECTOR = 64 * 1024
_OVERLAP = 64
"""Bytes that a block holds of the next one, so that a pattern on the border is found."""


class FileBytes:
    """What stands in an open file from byte ``start`` on, as of now; used like `bytes`. Zeros where
    the disk gives an error, which no checksum takes for data."""

    def __init__(self, fd: int, start: int = 0) -> None:
        self._fd = os.dup(fd)
        self._start = start
        self._size = max(0, os.fstat(self._fd).st_size - start)
        self._block_at = -1
        self._block = b""

    @classmethod
    def of(cls, path: Path) -> "FileBytes":
        """Those of the whole file at ``path``. Raises OSError."""
        fd = os.open(path, os.O_RDONLY)
        try:
            return cls(fd)
        finally:
            os.close(fd)

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        at, stop, step = part.indices(self._size)
        if step != 1:
            raise ValueError("only whole stretches of a file can be read")
        return self._read(at, max(0, stop - at))

    def startswith(self, prefix: bytes, at: int = 0) -> bool:
        """Whether ``prefix`` stands at byte ``at``."""
        return self[at : at + len(prefix)] == prefix

    def find(self, pattern: bytes, start: int = 0, end: int | None = None) -> int:
        """As `bytes.find`. ``pattern`` is short, and does not begin with a zero byte: it is not
        looked for in holes."""
        end = self._size if end is None else min(end, self._size)
        at = max(start, 0)
        while at + len(pattern) <= end:
            if not self._in_block(at):
                at = self._data_from(at)
                self._load(at)
            block = self._block_at
            stop = min(block + _BLOCK + len(pattern) - 1, end)
            found = self._block.find(pattern, at - block, stop - block)
            if found >= 0:
                return block + found
            at = block + _BLOCK
        return -1

    def rfind(self, pattern: bytes, start: int = 0, end: int | None = None) -> int:
        """As `bytes.rfind`, with the same exception."""
        stop = self._size if end is None else min(end, self._size)
        while stop - len(pattern) >= start:
            at = max(start, stop - _BLOCK - len(pattern))
            if self._data_from(at) < stop:
                found = self[at:stop].rfind(pattern)
                if found >= 0:
                    return at + found
            if at == start:
                break
            stop = at + len(pattern) - 1
        return -1

    def _in_block(self, at: int) -> bool:
        return self._block_at >= 0 and 0 <= at - self._block_at < _BLOCK

    def _load(self, at: int) -> None:
        self._block_at = at - at % _BLOCK
        length = min(_BLOCK + _OVERLAP, self._size - self._block_at)
        self._block = self._pread(self._block_at, length)

    def _data_from(self, at: int) -> int:
        """The first byte from ``at`` on that is not in a hole; the end if there is none."""
        try:
            return min(os.lseek(self._fd, self._start + at, os.SEEK_DATA) - self._start, self._size)
        except OSError as error:
            return self._size if error.errno == errno.ENXIO else at  # others: it knows no holes

    def _read(self, at: int, length: int) -> bytes:
        if length > _BLOCK:
            return self._pread(at, length)
        if not self._in_block(at):
            self._load(at)
        start = at - self._block_at
        data = self._block[start : start + length]
        rest = length - len(data)
        return data + self._pread(at + len(data), rest) if rest else data

    def _pread(self, at: int, length: int) -> bytes:
        try:
            return os.pread(self._fd, length, self._start + at)
        except OSError:
            sectors = range(at, at + length, _SECTOR)
            return b"".join(self._sector(s, min(_SECTOR, at + length - s)) for s in sectors)

    def _sector(self, at: int, length: int) -> bytes:
        try:
            return os.pread(self._fd, length, self._start + at)
        except OSError:
            return bytes(length)

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._fd)

    def __enter__(self) -> "FileBytes":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.close()
