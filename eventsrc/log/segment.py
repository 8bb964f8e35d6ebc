"""Segments, read side: where each chunk of events stands, and the events of one chunk."""

import os
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from eventsrc.envelope import Offset
from eventsrc.errors import LogDamaged

from . import mcap_records as _mcap
from .event import Event
from .format import HEAD_BYTES, envelope_version, read_head
from .mcap_records import BadRecord, Channel


@dataclass(frozen=True, slots=True)
class ChunkRef:
    """Where a chunk stands and which offsets it holds. ``channels`` is None where not known.
    ``body`` gives the records where the events do not stand in a chunk of ours."""

    position: int
    length: int
    first: Offset
    following: Offset
    channels: frozenset[int] | None = None
    body: Callable[[], bytes] | None = None


@dataclass(frozen=True, slots=True)
class Unreadable:
    """Offsets ``first`` to ``last`` (included) that were recorded and cannot be read, and why."""

    first: Offset
    last: Offset
    reason: str


class SegmentFile:
    """An open segment file and what its head says."""

    def __init__(self, path: Path, base: Offset) -> None:
        self._fd = -1  # for __del__, should opening fail
        self.path = path
        self.base = base
        self.chunks: list[ChunkRef] = []
        self.next_offset = base
        self._fd = os.open(path, os.O_RDONLY)
        try:
            self.head, self.head_bytes = read_head(path, os.pread(self._fd, HEAD_BYTES, 0), base)
        except BaseException:
            self.close()
            raise
        self.log_id = self.head["log_id"]

    def read_chunk(self, chunk: ChunkRef) -> bytes:
        """The chunk's body, CRC checked; LogDamaged otherwise."""
        try:
            return _mcap.read_chunk(partial(os.pread, self._fd), chunk.length, chunk.position)
        except BadRecord as error:
            raise LogDamaged(f"{self.path.name} at byte {chunk.position}: {error}") from None
        except OSError as error:  # a bad sector
            reason = error.strerror or str(error)
            raise LogDamaged(f"{self.path.name} at byte {chunk.position}: {reason}") from error

    def channels_of(self, body: bytes) -> dict[int, Channel]:
        """The channels that the messages of a chunk's body may name, by id."""
        raise NotImplementedError

    def size(self) -> int:
        """Bytes of the file now."""
        return os.fstat(self._fd).st_size

    def close(self) -> None:
        """Let go of the file. May be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __del__(self) -> None:
        # Iterators share a segment with the reader that opened it; the last one closes the file.
        self.close()


def chunk_events(
    segment: SegmentFile, chunk: ChunkRef, start: Offset, end: Offset, keys: Collection[str] | None
) -> Iterator[Event]:
    """The events of one chunk with offsets from ``start`` to before ``end``, in order. Raises
    LogDamaged for bytes that are not what was written, and for a chunk that contradicts itself."""
    body = segment.read_chunk(chunk)
    try:
        yield from _events(segment, chunk, body, start, end, keys)
    except (BadRecord, KeyError) as error:
        raise LogDamaged(f"{segment.path.name} at byte {chunk.position}: {error}") from None


def _events(
    segment: SegmentFile,
    chunk: ChunkRef,
    body: bytes,
    start: Offset,
    end: Offset,
    keys: Collection[str] | None,
) -> Iterator[Event]:
    channels = segment.channels_of(body)
    names = {id_: channel.topic for id_, channel in channels.items()}
    versions = {id_: envelope_version(channel) for id_, channel in channels.items()}
    base: int = segment.base
    expected: int = chunk.first
    for channel_id, sequence, log_ns, publish_ns, at, stop in _mcap.walk(body):
        offset = base + sequence
        if offset != expected:
            raise BadRecord(f"offset {offset} stands in place of {expected}")
        expected = offset + 1
        if offset < start:
            continue
        if offset >= end:
            return
        key = names[channel_id]
        if keys is None or key in keys:
            version = versions[channel_id]
            # No call of Offset for each event: reading would take 5 % longer.
            yield Event(offset, key, log_ns, publish_ns, body[at:stop], version)  # type: ignore[arg-type]
    if expected != chunk.following:
        raise BadRecord(f"the chunk ends before offset {expected}")
