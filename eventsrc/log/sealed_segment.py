"""Read a sealed segment through its summary and seal, and check all of its bytes.

Summary and seal name every chunk with its first offset and channels, so nothing before a wanted
event is read. `check_sealed` compares every byte with a checksum: the CRC in DataEnd covers all
before it, the CRC in the footer the summary and the footer, and the magic ends the file.
"""

import hashlib
import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from eventsrc.base.errors import LogDamaged
from eventsrc.base.machine import crc32
from eventsrc.base.text import advised
from eventsrc.envelope.model import Offset

from . import mcap_records as _mcap
from .channels import NO_SCHEMA, is_verbatim
from .format import end_in, is_metadata_of
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
        crc = 0
        at = 0
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
    if os.pread(fd, _DATA_END_BYTES, at) != _mcap.encode(_mcap.DataEnd(crc)):
        return "the data section does not match its CRC"
    return None


def _summary_fault(fd: int, start: int, size: int, tail: bytes) -> str | None:
    crc = 0
    for at in range(start, size - _mcap.TAIL_BYTES, _BLOCK):
        crc = crc32(os.pread(fd, min(_BLOCK, size - _mcap.TAIL_BYTES - at), at), crc)
    footer = tail[: _mcap.FOOTER_BYTES]
    if crc32(footer[:-4], crc) != int.from_bytes(footer[-4:], "little"):
        return "the summary does not match its CRC"
    return None
