"""Reading a file from a disk that may be failing."""

import os
from pathlib import Path

_BLOCK = 64 * 1024


def read_whatever_can_be(path: Path) -> bytes:
    """The whole file; zeros where the disk gives an error, which no checksum takes for data.

    Segments are rotated at 64 MiB, so this is what it takes in memory. Not mapped: a bad sector
    under a mapping kills the process.
    """
    with path.open("rb", buffering=0) as file:
        fd = file.fileno()
        size = os.fstat(fd).st_size
        return b"".join(_block(fd, at, min(_BLOCK, size - at)) for at in range(0, size, _BLOCK))


def _block(fd: int, at: int, length: int) -> bytes:
    try:
        return os.pread(fd, length, at)
    except OSError:
        return bytes(length)
