"""Read the bytes of a file that may be huge, sparse, damaged, or on a failing disk.

Files are read in blocks, on demand, so memory does not grow with the file; searches skip the holes
of a sparse file. The file is not mapped, because a bad sector under a mapping kills the process.

`skip_damaged` says where reading an active segment can go on behind a damaged record. The file is a
sequence of chunks, each followed by its commit mark. A mark counts only where a record begins,
because the payloads in a chunk may contain anything, marks included. So records are skipped by
their lengths:

* If the head of a chunk is good, its end is known even if its content is damaged. A chunk that
  would end behind the end of the file was being written when its writer died: nothing follows.
* If the head is damaged too, the next commit mark is searched for. It must be made with the mark
  seed of the segment, which publishers do not have, and must not declare more events than the bytes
  before it can hold.
"""

import errno
import os
from pathlib import Path
from typing import NamedTuple

from eventsrc.envelope.model import Offset

from . import mcap_records as _mcap
from .mcap_records import BadRecord

BLOCK_BYTES = 1024 * 1024
_SECTOR = 64 * 1024
_OVERLAP = 64
"""Bytes of the next block that each block includes, to find a pattern across the border."""


class FileBytes:
    """The current content of an open file from byte ``start`` on, used like `bytes`. Sectors that
    the disk cannot read are zeros, which no checksum accepts as data."""

    def __init__(self, fd: int, start: int = 0) -> None:
        self._fd = os.dup(fd)
        self._start = start
        self._size = max(0, os.fstat(self._fd).st_size - start)
        self._block_at = -1
        self._block = b""

    @classmethod
    def of(cls, path: Path) -> "FileBytes":
        """The bytes of the whole file at ``path``. Raises OSError."""
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
            raise ValueError("slices of a file have no step")
        return self._read(at, max(0, stop - at))

    def startswith(self, prefix: bytes, at: int = 0) -> bool:
        """Whether ``prefix`` is at byte ``at``."""
        return self[at : at + len(prefix)] == prefix

    def find(self, pattern: bytes, start: int = 0, end: int | None = None) -> int:
        """As `bytes.find`, for a short ``pattern`` that does not begin with a zero byte: holes are
        not searched."""
        end = self._size if end is None else min(end, self._size)
        at = max(start, 0)
        while at + len(pattern) <= end:
            if not self._in_block(at):
                at = self._data_from(at)
                if at + len(pattern) > end:
                    break
                self._load(at)
            block = self._block_at
            stop = min(block + BLOCK_BYTES + len(pattern) - 1, end)
            found = self._block.find(pattern, at - block, stop - block)
            if found >= 0:
                return block + found
            at = block + BLOCK_BYTES
        return -1

    def rfind(self, pattern: bytes, start: int = 0, end: int | None = None) -> int:
        """As `bytes.rfind`, with the same restriction."""
        stop = self._size if end is None else min(end, self._size)
        while stop - len(pattern) >= start:
            at = max(start, stop - BLOCK_BYTES - len(pattern))
            if self._data_from(at) < stop:
                found = self[at:stop].rfind(pattern)
                if found >= 0:
                    return at + found
            if at == start:
                break
            stop = at + len(pattern) - 1
        return -1

    def _in_block(self, at: int) -> bool:
        return self._block_at >= 0 and 0 <= at - self._block_at < BLOCK_BYTES

    def _load(self, at: int) -> None:
        self._block_at = at - at % BLOCK_BYTES
        length = min(BLOCK_BYTES + _OVERLAP, self._size - self._block_at)
        self._block = self._pread(self._block_at, length)

    def _data_from(self, at: int) -> int:
        """The first byte from ``at`` on that is not in a hole, or the end."""
        try:
            return min(os.lseek(self._fd, self._start + at, os.SEEK_DATA) - self._start, self._size)
        except OSError as error:
            return self._size if error.errno == errno.ENXIO else at  # others: no holes supported

    def _read(self, at: int, length: int) -> bytes:
        if length > BLOCK_BYTES:
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
        """Close the file."""
        os.close(self._fd)

    def __enter__(self) -> "FileBytes":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Resumption(NamedTuple):
    """Reading can go on at byte ``at``; offsets before ``recorded_end`` were recorded, by a mark
    that was passed (the expected offset if there was none)."""

    at: int
    recorded_end: Offset


class DamagedBytes(NamedTuple):
    """Unreadable bytes from ``start`` on, where the event of offset ``expected`` should be."""

    start: int
    expected: Offset


def skip_damaged(data: FileBytes, at: int, damaged: DamagedBytes, seed: int | None) -> Resumption:
    """Skip the damaged record at byte ``at``. Without the segment's mark ``seed`` no mark can be
    recognised."""
    end = _chunk_end(data, at)
    if end is None:
        if _chunk_end(data, at + _mcap.MARK_BYTES) is not None:  # a damaged mark
            return Resumption(at + _mcap.MARK_BYTES, damaged.expected)
        return _find_mark(data, at, damaged, seed)
    if end > len(data):
        return Resumption(len(data), damaged.expected)
    recorded_end = _recorded_end(data, end, damaged, seed)
    if recorded_end is not None:
        return Resumption(end + _mcap.MARK_BYTES, recorded_end)
    if _chunk_end(data, end + _mcap.MARK_BYTES) is not None:
        return Resumption(end + _mcap.MARK_BYTES, damaged.expected)
    return _find_mark(data, end, damaged, seed)


def _chunk_end(data: FileBytes, at: int) -> int | None:
    try:
        head = _mcap.decode_chunk_head(data[at : at + _mcap.PLAIN_CHUNK_HEAD])
    except BadRecord:
        return None
    return at + head.length


def _recorded_end(
    data: FileBytes, at: int, damaged: DamagedBytes, seed: int | None
) -> Offset | None:
    """The next offset of the commit mark at byte ``at``; None without a plausible mark."""
    if seed is None:
        return None
    try:
        first, following = _mcap.decode_mark(data[at : at + _mcap.MARK_BYTES], seed)
    except BadRecord:
        return None
    max_events = (at - damaged.start) // _mcap.MESSAGE_HEAD
    if damaged.expected <= first < following <= damaged.expected + max_events:
        return following
    return None


def _find_mark(data: FileBytes, at: int, damaged: DamagedBytes, seed: int | None) -> Resumption:
    at -= 1
    while (at := data.find(_mcap.MARK_PATTERN, at + 1)) >= 0:
        recorded_end = _recorded_end(data, at, damaged, seed)
        if recorded_end is not None:
            return Resumption(at + _mcap.MARK_BYTES, recorded_end)
    return Resumption(len(data), damaged.expected)
