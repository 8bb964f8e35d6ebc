"""Read a sealed segment through its summary and seal, and check all of its bytes.

Summary and seal name every chunk with its first offset and channels, so nothing before a wanted
event is read. `check_sealed` compares every byte with a checksum: the CRC in DataEnd covers all
before it, the CRC in the footer the summary and the footer, and the magic ends the file.

A segment that is *away* is in an archive only. A sparse file, `names.AWAY`, stands for it: as long
as the segment, with its head, seal and summary in their places. So everything but events is read as
from the segment itself. A chunk is fetched by its range when it is first read, checked by its CRC
like any other, and written into the file, from which it may go again when these take too much.
`eventsrc.log.archive_place` says where.
"""

import contextlib
import hashlib
import os
from bisect import bisect_left
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Final

from eventsrc.base.errors import ArchiveError, LogDamaged
from eventsrc.base.machine import crc32
from eventsrc.base.object_store import ObjectStore
from eventsrc.base.text import advised
from eventsrc.envelope.model import Offset

from . import mcap_records as _mcap
from .archive_place import ArchivePlace, archive_place, stand_in
from .channels import NO_SCHEMA, is_verbatim
from .format import (
    ARCHIVE,
    AWAY,
    HEAD_BYTES,
    SEALED,
    end_in,
    is_metadata_of,
    list_segments,
    segment_path,
)
from .segment import ChunkRef, SegmentFile

SEAL_METADATA = "mapfold.seal"
"""First part of the name of a segment's seal: see `metadata_name`."""
_MAX_CHUNKS = 1 << 16
"""Limit for the chunks of one segment: a chunk is 1 MiB or a single event, and a segment is full at
64 MiB."""
_BLOCK = 1024 * 1024
_DATA_END_BYTES = _mcap.FRAME.size + 4


class SealedFile(SegmentFile):
    """A sealed segment, opened by reading its summary. Raises LogDamaged if that is unreadable."""

    def __init__(self, path: Path, base: Offset) -> None:
        super().__init__(path, base)
        self.channels: dict[int, _mcap.Channel] = {}
        self.index_at = 0
        """The byte behind the chunks, at which the seal begins."""
        self.schemas: dict[int, _mcap.Schema] = {}
        """The schemas of verbatim messages, by id."""
        try:
            self._read_summary()
        except (ValueError, KeyError) as error:
            self.close()
            raise LogDamaged(
                f"{path}: the index at its end cannot be read, which leaves offsets from {base} "
                f"unreadable: {error}; run `{advised('log', 'recover', path.parent)}`"
            ) from None
        except BaseException:
            self.close()
            raise

    def ends(self) -> dict[int, bytes]:
        """What is before and behind the chunks, by position: enough for a file to `stand_in`."""
        head = os.pread(self._fd, min(HEAD_BYTES, self.index_at), 0)
        return {
            0: head,
            self.index_at: os.pread(self._fd, self.size() - self.index_at, self.index_at),
        }

    def channels_of(self, body: bytes) -> dict[int, _mcap.Channel]:  # noqa: ARG002
        """All channels, from the summary."""
        return self.channels

    def schemas_of(self, body: bytes) -> dict[int, _mcap.Schema]:  # noqa: ARG002
        """All schemas of verbatim messages, from the summary."""
        return self.schemas

    def _read_summary(self) -> None:
        size = self.size()
        tail = os.pread(self._fd, _mcap.TAIL_BYTES, max(0, size - _mcap.TAIL_BYTES))
        if not tail.endswith(_mcap.MAGIC) or tail[0] != _mcap.Opcode.FOOTER:
            raise _mcap.BadRecord("no footer")
        footer = _mcap.decode_as(_mcap.Footer, tail[_mcap.FRAME.size :])
        if not 0 < footer.summary_start <= size - _mcap.TAIL_BYTES:
            raise _mcap.BadRecord("the footer points outside the file")
        length = size - _mcap.TAIL_BYTES - footer.summary_start
        if length > _mcap.MAX_SUMMARY_BYTES:
            raise _mcap.BadRecord(
                f"a summary of {length:,} bytes, more than {_mcap.MAX_SUMMARY_BYTES:,}"
            )
        summary = os.pread(self._fd, length, footer.summary_start)
        if crc32(tail[: _mcap.FOOTER_BYTES - 4], crc32(summary)) != footer.summary_crc:
            raise _mcap.BadRecord("the summary does not match its CRC")
        self._parse_summary(summary, size)

    def _parse_summary(self, summary: bytes, size: int) -> None:
        indexes: list[tuple[int, int, frozenset[int]]] = []
        schemas: list[bytes] = []
        statistics, seal = None, None
        definitions = 0
        for opcode, content in _mcap.records(summary):
            if opcode == _mcap.Opcode.CHUNK_INDEX:
                indexes.append(_chunk_position(_mcap.decode_as(_mcap.ChunkIndex, content), size))
                if len(indexes) > _MAX_CHUNKS:
                    raise _mcap.BadRecord(f"an index of more than {_MAX_CHUNKS:,} chunks")
            elif opcode == _mcap.Opcode.SCHEMA:
                schemas.append(content)
            elif opcode == _mcap.Opcode.CHANNEL:
                definitions += len(content)
                _mcap.check_definitions(definitions)
                channel = _mcap.decode_as(_mcap.Channel, content)
                self.channels[channel.id] = channel
            elif opcode == _mcap.Opcode.STATISTICS:
                statistics = _mcap.decode_as(_mcap.Statistics, content)
            elif opcode == _mcap.Opcode.METADATA_INDEX:
                index = _mcap.decode_as(_mcap.MetadataIndex, content)
                if is_metadata_of(SEAL_METADATA, index.name):
                    self.index_at = index.offset
                    seal = self._metadata(index, size)
        if statistics is None or seal is None:
            raise _mcap.BadRecord("no statistics or no seal")
        if not self.channels.keys() >= statistics.channel_message_counts.keys():
            raise _mcap.BadRecord("statistics of channels that nothing defines")
        self._keep_schemas(schemas)
        self.statistics, self.seal = statistics, seal
        self.first_stamp_ns = int(seal["first_stamp_ns"])
        self.last_stamp_ns = int(seal["last_stamp_ns"])
        self._set_chunks(indexes)

    def _keep_schemas(self, contents: list[bytes]) -> None:
        """Keep the schemas of verbatim messages; usually there are none."""
        wanted = {c.schema_id for c in self.channels.values() if is_verbatim(c)} - {NO_SCHEMA}
        if not wanted:
            return
        _mcap.check_definitions(sum(map(len, contents)))
        schemas = (_mcap.decode_as(_mcap.Schema, content) for content in contents)
        self.schemas = {schema.id: schema for schema in schemas if schema.id in wanted}

    def _metadata(self, index: _mcap.MetadataIndex, size: int) -> dict[str, str]:
        if index.length > _mcap.MAX_DEFINITIONS_BYTES or index.offset + index.length > size:
            raise _mcap.BadRecord("the seal is out of bounds")
        record = os.pread(self._fd, index.length, index.offset)
        content = record[_mcap.FRAME.size :]
        return _mcap.checked_metadata(_mcap.decode_as(_mcap.Metadata, content))

    def _set_chunks(self, indexes: list[tuple[int, int, frozenset[int]]]) -> None:
        edges = sealed_edges(self.seal["chunk_edges"], self.base)
        if len(edges) != len(indexes) + 1:
            raise _mcap.BadRecord("the seal does not fit the index")
        if end_in(self.head, edges[-1]) != edges[-1]:
            raise _mcap.BadRecord("the seal does not fit the head")
        self.chunks = [
            ChunkRef(position, length, first, following, channels)
            for (position, length, channels), (first, following) in zip(
                indexes, pairwise(edges), strict=True
            )
        ]


FETCHED_BYTES: Final = 1024 * 1024 * 1024
"""What the fetched chunks of a log may take on the disk."""
_FETCHED_AT_ONCE: Final = 8
"""Chunks that one request fetches when they are read in turn: 8 MB before they are compressed."""


class AwayFile(SealedFile):
    """A segment that is away. Its chunks raise ArchiveError when the archive does not answer."""

    def __init__(self, path: Path, base: Offset) -> None:
        super().__init__(path, base)
        self._next = -1
        """The index of the chunk behind those fetched last."""

    def read_chunk(self, chunk: ChunkRef) -> bytes:
        """The chunk's body, fetched if it is not in the file; LogDamaged if it is wrong there."""
        with contextlib.suppress(LogDamaged):
            return super().read_chunk(chunk)
        start = chunk.position
        index = bisect_left(self.chunks, start, key=lambda each: each.position)
        count = _FETCHED_AT_ONCE if index == self._next else 1
        self._next = min(index + count, len(self.chunks))
        last = self.chunks[self._next - 1]
        place, name = self._place()
        try:
            data = _store(place.url).part(name, start, last.position + last.length)
        except ArchiveError as error:
            raise type(error)(f"{self.path} is in the archive only: {error}") from None
        try:
            body = _mcap.read_chunk(lambda n, at: data[at - start :][:n], chunk.length, start)
        except _mcap.BadRecord as error:
            raise LogDamaged(f"{place.url}/{name} at byte {start}: {error}") from None
        self._keep(data, start)
        return body

    def _place(self) -> tuple[ArchivePlace, str]:
        place = archive_place(self.path.parent)
        if place is None or self.path.name not in place.objects:
            raise LogDamaged(f"{self.path}: {ARCHIVE} does not say where this segment is archived")
        return place, place.objects[self.path.name]

    def _keep(self, data: bytes, at: int) -> None:
        """Write a fetched part into the file; where it cannot be written it is fetched again."""
        with contextlib.suppress(OSError):
            with self.path.open("r+b") as file:
                os.pwrite(file.fileno(), data, at)
            empty_oldest(self.path.parent, but=self.path)


def open_sealed(log: Path, base: Offset) -> SealedFile:
    """The sealed segment at ``base``, here or away: it may have changed since it was listed."""
    for suffix, kind in ((SEALED, SealedFile), (AWAY, AwayFile)):
        with contextlib.suppress(FileNotFoundError):
            return kind(segment_path(log, base, suffix), base)
    return SealedFile(segment_path(log, base, SEALED), base)


@lru_cache(maxsize=8)
def _store(url: str) -> ObjectStore:
    return ObjectStore(url)


def empty_oldest(log: Path, *, but: Path | None = None) -> None:
    """While fetched chunks take more than `FETCHED_BYTES`, drop those of the segment that was
    fetched to longest ago. Raises OSError."""
    status = {each.path: each.path.stat() for each in list_segments(log) if each.away}
    taken = sum(each.st_blocks * 512 for each in status.values())
    for path in sorted(status, key=lambda path: status[path].st_mtime_ns):
        if taken <= FETCHED_BYTES:
            return
        if path != but:
            taken -= status[path].st_blocks * 512
            empty(path)


def empty(path: Path) -> None:
    """Drop the chunks of the file that stands for a segment away. Raises OSError, LogError."""
    file = AwayFile(path, Offset(int(path.name[:20])))
    try:
        stand_in(path, file.size(), file.ends())
    finally:
        file.close()


def sealed_edges(text: str, base: Offset) -> list[Offset]:
    """Offsets at which the chunks of a segment begin and the last one ends, from its seal. Raises
    ValueError."""
    edges = [Offset(base + int(number)) for number in text.split(",")]
    if edges[0] != base or any(one >= other for one, other in pairwise(edges)):
        raise _mcap.BadRecord("the chunk edges in the seal do not ascend")
    return edges


def _chunk_position(index: _mcap.ChunkIndex, size: int) -> tuple[int, int, frozenset[int]]:
    """Position, length and channels of a chunk. Raises BadRecord if it is not in the file."""
    position, length = index.chunk_start_offset, index.chunk_length
    if position + length > size:
        raise _mcap.BadRecord(
            f"a chunk of {length:,} bytes at byte {position:,} of a file of {size:,} bytes"
        )
    return position, length, frozenset(index.message_index_offsets)


@dataclass(frozen=True, slots=True)
class FileCheck:
    """``sha256`` of the whole file; ``fault`` is None when every checksum is right."""

    sha256: str
    fault: str | None


def check_sealed(path: Path) -> FileCheck:
    """Compare the whole file with its checksums, a block at a time."""
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
            return FileCheck("", fault)  # damaged, so its hash does not matter
        data_end_at = summary_start - _DATA_END_BYTES
        sha256 = hashlib.sha256()
        crc = at = 0
        while block := file.read(_BLOCK):
            sha256.update(block)
            crc = crc32(block[: max(0, data_end_at - at)], crc)
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
        return _DATA_END_BYTES, "the footer points outside the file"
    if size - start > _mcap.MAX_SUMMARY_BYTES + _mcap.TAIL_BYTES:
        return _DATA_END_BYTES, f"the footer claims a summary of {size - start:,} bytes"
    return start, None


def _data_end_fault(fd: int, at: int, crc: int) -> str | None:
    is_right = os.pread(fd, _DATA_END_BYTES, at) == _mcap.encode(_mcap.DataEnd(crc))
    return None if is_right else "the data section does not match its CRC"


def _summary_fault(fd: int, start: int, size: int, tail: bytes) -> str | None:
    crc = 0
    for at in range(start, size - _mcap.TAIL_BYTES, _BLOCK):
        crc = crc32(os.pread(fd, min(_BLOCK, size - _mcap.TAIL_BYTES - at), at), crc)
    footer = tail[: _mcap.FOOTER_BYTES]
    if crc32(footer[:-4], crc) != int.from_bytes(footer[-4:], "little"):
        return "the summary does not match its CRC"
    return None
