"""Scan a sealed segment for its good chunks, by its index or, if that is damaged, by searching the
bytes for chunks. Every chunk is decompressed, and its CRC and sequence numbers are checked."""

import contextlib
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path

from eventsrc.base.errors import LogDamaged, NotALog
from eventsrc.envelope.model import Offset

from . import mcap_records as _mcap
from .file_bytes import FileBytes
from .format import HEAD_BYTES, WrongPlace, end_in, read_head
from .mcap_records import BadRecord, Metadata
from .scan import check_chunk
from .sealed_segment import SEAL_METADATA, SealedFile, sealed_edges
from .segment import ChunkRef, Scan


def scan_sealed(path: Path, base: Offset, following: Offset | None) -> Scan:
    """Scan every chunk. ``following`` is the base of the next segment, if there is one: where this
    one ends if its index is damaged. A segment that was cut, and where nothing says how many events
    it had, lacks at least one. Raises WrongPlace for a segment of another base."""
    with FileBytes.of(path) as data:
        return _scan(path, data, base, following)


def _scan(path: Path, data: FileBytes, base: Offset, following: Offset | None) -> Scan:
    head = _head(path, base, data)
    scan = Scan(base, head.get("log_id"), next_offset=base)
    edges: set[tuple[Offset, Offset]] | None = None
    try:
        index = SealedFile(path, base)
        recorded_end = index.next_offset
        scan.channels, scan.schemas = index.channels, index.schemas
        places: Iterable[int] = [chunk.position for chunk in index.chunks]
    except (LogDamaged, NotALog) as error:
        scan.index_fault = str(error)
        places = _find_chunks(data)
        offsets = _find_seal_edges(data, base, max(_find_chunks(data), default=0))
        recorded_end = offsets[-1]
        edges = set(pairwise(offsets)) or None
    end = 0
    for at in places:
        if at < end:  # inside the chunk before, where payloads may look like chunks
            continue
        try:
            length, first, after = check_chunk(data, at, scan)
        except BadRecord:
            continue
        if first >= scan.next_offset and (edges is None or (first, after) in edges):
            scan.add_chunk(ChunkRef(at, length, first, after))
            end = at + length
    recorded_end = max(recorded_end, end_in(head, base), following or base)
    scan.add_gap_until(recorded_end)
    if recorded_end == base and not _ends_in_magic(data):
        # It was cut, and its head, which names its end, is damaged too.
        scan.add_gap_until(Offset(scan.next_offset + 1))
    scan.lost_bytes = _count_lost_bytes(len(data), scan)
    return scan


def _head(path: Path, base: Offset, data: FileBytes) -> dict[str, str]:
    """The values in the head, none if it is damaged."""
    try:
        return read_head(path, data[:HEAD_BYTES], base)[0]
    except WrongPlace:
        raise
    except (LogDamaged, NotALog):
        return {}


def _ends_in_magic(data: FileBytes) -> bool:
    return data[max(0, len(data) - len(_mcap.MAGIC)) : len(data)] == _mcap.MAGIC


def _find_chunks(data: FileBytes) -> Iterator[int]:
    """Positions at which chunks seem to start. The content of a chunk with a good head is not
    searched: payloads may look like chunks."""
    at = -1
    while (at := data.find(_mcap.ZSTD_PATTERN, at + 1)) >= 0:
        start = at - _mcap.ZSTD_PATTERN_AT
        try:
            head = _mcap.decode_chunk_head(data[max(0, start) : start + _mcap.ZSTD_CHUNK_HEAD])
        except BadRecord:
            continue
        yield start
        if start + head.length <= len(data):
            at = start + head.length - 1


def _find_seal_edges(data: FileBytes, base: Offset, last_chunk: int) -> list[Offset]:
    """The offsets at which chunks begin and the last one ends, from the seal behind the last chunk;
    the base alone if the seal cannot be found."""
    name = SEAL_METADATA.encode()
    with contextlib.suppress(BadRecord):
        head = _mcap.decode_chunk_head(data[last_chunk : last_chunk + _mcap.ZSTD_CHUNK_HEAD])
        last_chunk += head.length
    at = data.rfind(name, last_chunk)
    while at >= 0:
        try:
            start = at - 4
            content = data[start : start + _mcap.MAX_DEFINITIONS_BYTES]
            metadata = _mcap.decode_as(Metadata, content)
            edges = _mcap.checked_metadata(metadata)["chunk_edges"]
            return sealed_edges(edges, base)
        except (KeyError, ValueError):
            at = data.rfind(name, last_chunk, at)
    return [base]


def _count_lost_bytes(size: int, scan: Scan) -> int:
    """Bytes between the chunks around each gap, including message indexes there."""
    lost, end, expected = 0, 0, scan.base
    for chunk in scan.chunks:
        if chunk.first > expected:
            lost += chunk.position - end
        end, expected = chunk.position + chunk.length, chunk.following
    return lost + (size - end if scan.next_offset > expected else 0)
