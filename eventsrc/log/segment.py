"""Segments, read side: where each chunk of events stands, and the events of one chunk.

A sealed segment is opened by its footer: summary and seal name every chunk, its first offset and
its channels, so nothing before the wanted event is read. An active one has no index; its chunk
heads and commit marks are hopped over once (80 bytes each) and again only from where that ended.
"""

import os
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from eventsrc.envelope import ENVELOPE_VERSION
from eventsrc.errors import LogDamaged, NotALog

from . import _mcap
from ._active import ENVELOPE_VERSION_KEY, SEGMENT_METADATA
from ._mcap import (
    BadRecord,
    Channel,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Opcode,
    Statistics,
)
from ._naming import SEALED, segment_path
from .event import Event

SEAL_METADATA = "mapfold.seal"
_HEAD_READ = 4096


@dataclass(frozen=True, slots=True)
class ChunkRef:
    """Where a chunk stands and which offsets it holds. ``channels`` is None where not known."""

    position: int
    length: int
    first: int
    following: int
    channels: frozenset[int] | None = None


@dataclass(frozen=True, slots=True)
class Unreadable:
    """Offsets ``first`` to ``last`` (included) that were recorded and cannot be read, and why."""

    first: int
    last: int
    reason: str


class Segment(Protocol):
    """What a reader needs of a segment, sealed or active."""

    path: Path
    base: int
    log_id: str
    chunks: list[ChunkRef]
    next_offset: int

    def read_chunk(self, chunk: ChunkRef) -> bytes:
        """The chunk's body, CRC checked; LogDamaged naming the offsets otherwise."""

    def channels_of(self, body: bytes) -> dict[int, Channel]:
        """The channels its messages may name."""


class _File:
    """An open segment file and what its head says."""

    def __init__(self, path: Path, base: int) -> None:
        self._fd = -1  # for __del__, should opening fail
        self.path = path
        self.base = base
        self.chunks: list[ChunkRef] = []
        self.next_offset = base
        self._fd = os.open(path, os.O_RDONLY)
        try:
            self.head, self.head_bytes = read_head(path, os.pread(self._fd, _HEAD_READ, 0), base)
        except BaseException:
            self.close()
            raise
        self.log_id = self.head["log_id"]

    def read_chunk(self, chunk: ChunkRef) -> bytes:
        record = os.pread(self._fd, chunk.length, chunk.position)
        try:
            return _mcap.decode_chunk(record)
        except BadRecord as error:
            raise LogDamaged(f"{self.path.name} at byte {chunk.position}: {error}") from None

    def size(self) -> int:
        return os.fstat(self._fd).st_size

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __del__(self) -> None:
        # Iterators share a segment with the reader that opened it; the last one closes the file.
        self.close()


def read_head(path: Path, data: bytes, base: int) -> tuple[dict[str, str], int]:
    """Our metadata at the head of a segment and the byte after it."""
    if not data.startswith(_mcap.MAGIC) and not _mcap.MAGIC.startswith(data):
        raise NotALog(f"{path} is no MCAP file; it does not belong into a log, move it away")
    try:
        head = _find_head(data, base)
    except BadRecord as error:
        raise LogDamaged(
            f"{path}: damaged head: {error}; run `mapfold log recover {path.parent}`"
        ) from None
    if head is None:
        raise NotALog(f"{path} is an MCAP file but no segment of a log; `mapfold import` reads it")
    return head


def _find_head(data: bytes, base: int) -> tuple[dict[str, str], int] | None:
    """None for an MCAP head that is not ours."""
    at = len(_mcap.MAGIC)
    profile = _mcap.PROFILE
    try:
        for opcode, content in _mcap.records(data[at:]):
            at += _mcap.FRAME.size + len(content)
            if opcode == Opcode.HEADER:
                profile = _mcap.decode_as(Header, content).profile
            elif opcode == Opcode.METADATA:
                metadata = _mcap.decode_as(Metadata, content)
                if metadata.name == SEGMENT_METADATA:
                    return _checked_head(metadata, base), at
    except BadRecord:
        if profile == _mcap.PROFILE:
            raise
    if profile == _mcap.PROFILE:
        raise BadRecord("it ends before the segment's metadata")
    return None


def _checked_head(metadata: Metadata, base: int) -> dict[str, str]:
    values = _mcap.checked_metadata(metadata)
    if values["base"] != str(base):
        raise BadRecord(f"it was written as the segment at offset {values['base']}, not {base}")
    return values


class SealedFile(_File):
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


class ActiveFile(_File):
    """A growing or left-over segment, known as far as its commit marks go."""

    def __init__(self, path: Path, base: int) -> None:
        super().__init__(path, base)
        self.position = self.head_bytes
        try:
            self.refresh()
        except BaseException:
            self.close()
            raise

    def refresh(self) -> int:
        """Take in what was committed since; the next offset."""
        try:
            while self._take_commit():
                pass
        except BadRecord:
            # Either a chunk is just being written or the end is torn: nothing more is durable.
            # Whether good chunks lie behind is asked once, by `LogReader` and by verify.
            pass
        return self.next_offset

    def _take_commit(self) -> bool:
        head_bytes = os.pread(self._fd, _mcap.PLAIN_CHUNK_HEAD, self.position)
        if len(head_bytes) < _mcap.PLAIN_CHUNK_HEAD:
            return False
        head = _mcap.decode_chunk_head(head_bytes)
        mark_at = self.position + head.length
        first, following = _mcap.decode_mark(os.pread(self._fd, _mcap.MARK_BYTES, mark_at))
        if first != self.next_offset:
            raise BadRecord("a commit mark contradicts the one before it")
        chunk = ChunkRef(self.position, head.length, first, following)
        self.chunks.append(chunk)
        self.next_offset = following
        self.position = mark_at + _mcap.MARK_BYTES
        return True

    def was_replaced(self) -> bool:
        """Whether another file stands for this segment by now: sealed, or begun anew."""
        try:
            now = self.path.stat()
        except FileNotFoundError:
            return segment_path(self.path.parent, self.base, SEALED).exists()
        return now.st_ino != os.fstat(self._fd).st_ino

    def rot(self) -> Unreadable | None:
        """What once was durable behind the last readable commit. A crash tears only the end, and
        no commit mark can follow what was never synced; so where one does, bytes have rotted."""
        while self.position < self.size():
            rest = os.pread(self._fd, self.size() - self.position, self.position)
            promised = max(_mcap.marks_in(rest), default=0)
            before = self.next_offset
            if self.refresh() == before:  # else a writer was at work between the two looks
                if promised <= before:
                    return None
                return Unreadable(before, promised - 1, f"damaged at byte {self.position}")
        return None

    def channels_of(self, body: bytes) -> dict[int, Channel]:
        """By id, from the records that lead the chunk."""
        _, channels = _mcap.definitions(body, leading=True)
        return {channel.id: channel for channel in channels}


def envelope_version(channel: Channel) -> int:
    """The version of the envelopes on a channel; the current one where none is said."""
    return int(channel.metadata.get(ENVELOPE_VERSION_KEY, ENVELOPE_VERSION))


def chunk_events(
    segment: Segment, chunk: ChunkRef, start: int, end: int, keys: Collection[str] | None
) -> Iterator[Event]:
    """The events of one chunk with offsets from ``start`` to before ``end``, in order."""
    body = segment.read_chunk(chunk)
    names = {c.id: c.topic for c in segment.channels_of(body).values()}
    versions = {c.id: envelope_version(c) for c in segment.channels_of(body).values()}
    base, expected = segment.base, chunk.first
    for channel_id, sequence, log_ns, publish_ns, at, stop in _mcap.walk(body):
        offset = base + sequence
        if offset != expected:
            raise LogDamaged(f"{segment.path.name}: offset {offset} stands in place of {expected}")
        expected = offset + 1
        if offset < start:
            continue
        if offset >= end:
            return
        key = names[channel_id]
        if keys is None or key in keys:
            version = versions[channel_id]
            yield Event(offset, key, log_ns, publish_ns, body[at:stop], version)
    if expected != chunk.following:
        raise LogDamaged(f"{segment.path.name}: the chunk ends before offset {expected}")
