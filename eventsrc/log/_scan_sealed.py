"""What can still be read of a sealed segment: by its index, or, where that is gone, by searching
the bytes for chunks. Every chunk is decompressed and its CRC and sequence checked."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from eventsrc.errors import LogDamaged, NotALog

from . import _mcap
from ._bytes import FileBytes
from ._head import HEAD_BYTES, read_head
from ._mcap import BadRecord, Metadata
from ._scan import Scan, chunk_extent
from ._sealed_file import SEAL_METADATA, SealedFile
from .segment import ChunkRef


def scan_sealed(path: Path, base: int, following: int | None) -> Scan:
    """Look at every chunk. ``following`` is the base of the next segment, if there is one: how far
    this one reached when its own index cannot say."""
    with FileBytes.of(path) as data:
        return _scan(path, data, base, following)


def _scan(path: Path, data: FileBytes, base: int, following: int | None) -> Scan:
    scan = Scan(base, _log_id(path, base, data), next_offset=base)
    try:
        index = SealedFile(path, base)
        promised = index.next_offset
        scan.channels = index.channels
        places: Iterable[int] = [chunk.position for chunk in index.chunks]
    except (LogDamaged, NotALog) as error:
        scan.index_fault = str(error)
        promised = _promised(data, base)
        places = _chunk_places(data)
    for at in places:
        try:
            length, first, after = chunk_extent(data, at, scan)
        except BadRecord:
            continue
        if first >= scan.next_offset:
            scan.take(ChunkRef(at, length, first, after))
    scan.gap_up_to(max(promised, following or base))
    scan.lost_bytes = _unread_bytes(len(data), scan)
    return scan


def _log_id(path: Path, base: int, data: FileBytes) -> str | None:
    try:
        return read_head(path, data[:HEAD_BYTES], base)[0]["log_id"]
    except (LogDamaged, NotALog):
        return None


def _chunk_places(data: FileBytes) -> Iterator[int]:
    """Everywhere a compressed chunk seems to start."""
    at = -1
    while (at := data.find(_mcap.ZSTD_PATTERN, at + 1)) >= 0:
        if at >= _mcap.ZSTD_PATTERN_AT:
            yield at - _mcap.ZSTD_PATTERN_AT


def _promised(data: FileBytes, base: int) -> int:
    """How far the segment reached by its seal, if that can be found."""
    name = SEAL_METADATA.encode()
    at = data.rfind(name)
    while at >= 0:
        try:
            start = at - 4
            content = data[start : start + _mcap.MAX_DEFINITIONS_BYTES]
            metadata = _mcap.decode_as(Metadata, content)
            edges = _mcap.checked_metadata(metadata)["chunk_edges"]
            return base + int(edges.rsplit(",", 1)[-1])
        except (ValueError, KeyError):
            at = data.rfind(name, 0, at)
    return base


def _unread_bytes(size: int, scan: Scan) -> int:
    """Bytes between the chunks around each gap, indexes that stand there included."""
    lost, end, expected = 0, 0, scan.base
    for chunk in scan.chunks:
        if chunk.first > expected:
            lost += chunk.position - end
        end, expected = chunk.position + chunk.length, chunk.following
    return lost + (size - end if scan.next_offset > expected else 0)
