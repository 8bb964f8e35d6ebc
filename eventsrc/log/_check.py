"""Is every byte of a sealed segment what was sealed?

The CRC in DataEnd covers everything before it, the CRC in the footer the summary and the footer,
and the magic ends the file; so there is no byte that nothing checks.
"""

import hashlib
import os
import zlib
from dataclasses import dataclass
from pathlib import Path

from . import _mcap
from ._mcap import DataEnd

_BLOCK = 1024 * 1024
_DATA_END_BYTES = _mcap.FRAME.size + 4


@dataclass(frozen=True, slots=True)
class FileCheck:
    """``sha256`` of the whole file; ``fault`` is None when every checksum holds."""

    sha256: str
    fault: str | None


def check_sealed(path: Path) -> FileCheck:
    """Read the whole file, a block at a time."""
    try:
        return _check(path)
    except OSError as error:  # a bad sector
        return FileCheck("", f"the disk cannot read it: {error.strerror or error}")


def _check(path: Path) -> FileCheck:
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        tail = os.pread(file.fileno(), _mcap.TAIL_BYTES, max(0, size - _mcap.TAIL_BYTES))
        summary_start, fault = _summary_start(tail, size)
        if fault is not None:
            return FileCheck("", fault)  # it is not what was sealed, whatever its hash
        data_end_at = summary_start - _DATA_END_BYTES
        sha256 = hashlib.sha256()
        crc = 0
        at = 0
        while block := file.read(_BLOCK):
            sha256.update(block)
            crc = zlib.crc32(block[: max(0, data_end_at - at)], crc)
            at += len(block)
        fault = _data_end_fault(file.fileno(), data_end_at, crc)
        if fault is None:
            fault = _summary_fault(file.fileno(), summary_start, size, tail)
    return FileCheck(sha256.hexdigest(), fault)


def _summary_start(tail: bytes, size: int) -> tuple[int, str | None]:
    if len(tail) < _mcap.TAIL_BYTES or not tail.endswith(_mcap.MAGIC):
        return _DATA_END_BYTES, "no magic at its end"
    start = int.from_bytes(tail[9:17], "little")
    if not _DATA_END_BYTES < start < size:
        return _DATA_END_BYTES, "the footer points nowhere"
    if size - start > _mcap.MAX_SUMMARY_BYTES + _mcap.TAIL_BYTES:
        return _DATA_END_BYTES, f"the footer claims a summary of {size - start:,} bytes"
    return start, None


def _data_end_fault(fd: int, at: int, crc: int) -> str | None:
    if os.pread(fd, _DATA_END_BYTES, at) != _mcap.encode(DataEnd(crc)):
        return "the data section does not match its CRC"
    return None


def _summary_fault(fd: int, start: int, size: int, tail: bytes) -> str | None:
    crc = 0
    for at in range(start, size - _mcap.TAIL_BYTES, _BLOCK):
        crc = zlib.crc32(os.pread(fd, min(_BLOCK, size - _mcap.TAIL_BYTES - at), at), crc)
    footer = tail[: _mcap.FOOTER_BYTES]
    if zlib.crc32(footer[:-4], crc) != int.from_bytes(footer[-4:], "little"):
        return "the summary does not match its CRC"
    return None
