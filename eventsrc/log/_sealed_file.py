"""A sealed segment, known from its summary and its seal: they name every chunk, its first offset
and its channels, so nothing before the wanted event is read."""

import os
import zlib
from pathlib import Path

from eventsrc.errors import LogDamaged

from . import _mcap
from ._mcap import (
    BadRecord,
    Channel,
    ChunkIndex,
    Footer,
    Metadata,
    MetadataIndex,
    Opcode,
    Statistics,
)
from .segment import ChunkRef, SegmentFile

SEAL_METADATA = "mapfold.seal"


class SealedFile(SegmentFile):
    """An immutable segment, known from its summary."""

    def __init__(self, path: Path, base: int) -> None:
        super().__init__(path, base)
        self.channels: dict[int, Channel] = {}
        try:
            self._read_summary()
        except BadRecord as error:
            self.close()
            raise LogDamaged(
                f"{path}: the index at its end cannot be read, which leaves offsets from {base} "
                f"unreadable: {error}; run `mapfold log recover {path.parent}`"
            ) from None
        except BaseException:
            self.close()
            raise

    def channels_of(self, body: bytes) -> dict[int, Channel]:  # noqa: ARG002
        """The same for all chunks, from the summary."""
        return self.channels

    def _read_summary(self) -> None:
        size = self.size()
        tail = os.pread(self._fd, _mcap.TAIL_BYTES, max(0, size - _mcap.TAIL_BYTES))
        if not tail.endswith(_mcap.MAGIC) or tail[0] != Opcode.FOOTER:
            raise BadRecord("no footer")
        footer = _mcap.decode_as(Footer, tail[_mcap.FRAME.size :])
        if not 0 < footer.summary_start <= size - _mcap.TAIL_BYTES:
            raise BadRecord("the footer points nowhere")
        length = size - _mcap.TAIL_BYTES - footer.summary_start
        summary = os.pread(self._fd, length, footer.summary_start)
        if zlib.crc32(tail[: _mcap.FOOTER_BYTES - 4], zlib.crc32(summary)) != footer.summary_crc:
            raise BadRecord("the summary does not match its CRC")
        self._take(summary)

    def _take(self, summary: bytes) -> None:
        indexes: list[ChunkIndex] = []
        for opcode, content in _mcap.records(summary):
            if opcode == Opcode.CHUNK_INDEX:
                indexes.append(_mcap.decode_as(ChunkIndex, content))
            elif opcode == Opcode.CHANNEL:
                channel = _mcap.decode_as(Channel, content)
                self.channels[channel.id] = channel
            elif opcode == Opcode.STATISTICS:
                self.statistics = _mcap.decode_as(Statistics, content)
            elif opcode == Opcode.METADATA_INDEX:
                index = _mcap.decode_as(MetadataIndex, content)
                if index.name == SEAL_METADATA:
                    self.seal = self._metadata(index)
        self._take_chunks(indexes)

    def _metadata(self, index: MetadataIndex) -> dict[str, str]:
        record = os.pread(self._fd, index.length, index.offset)
        content = record[_mcap.FRAME.size :]
        return _mcap.checked_metadata(_mcap.decode_as(Metadata, content))

    def _take_chunks(self, indexes: list[ChunkIndex]) -> None:
        edges = [self.base + int(n) for n in self.seal["chunk_edges"].split(",")]
        if len(edges) != len(indexes) + 1:
            raise BadRecord("the seal does not fit the index")
        self.next_offset = edges[-1]
        self.chunks = [
            ChunkRef(
                index.chunk_start_offset,
                index.chunk_length,
                first,
                following,
                frozenset(index.message_index_offsets),
            )
            for index, first, following in zip(indexes, edges, edges[1:], strict=False)
        ]
