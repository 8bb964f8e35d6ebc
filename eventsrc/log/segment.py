"""An open segment file: where each chunk is, and the events of one chunk."""

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.model import FIRST_OFFSET, Offset

from . import mcap_records as _mcap
from .event import Event, MessageFormat, VerbatimEvent
from .format import HEAD_BYTES, envelope_version, is_verbatim, message_format, read_head
from .mcap_records import BadRecord, Channel, Schema


@dataclass(frozen=True, slots=True)
class ChunkRef:
    """Where a chunk is in its file (bytes) and which offsets it holds, ``first`` to before
    ``following``. ``channels`` is None if unknown. ``body``, if given, returns the records
    instead: made from a file that another program wrote."""

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


@dataclass(slots=True)
class Scan:
    """The good chunks of a segment, and the gaps between and behind them."""

    base: Offset
    log_id: str | None
    chunks: list[ChunkRef] = field(default_factory=list)
    gaps: list[tuple[Offset, Offset]] = field(default_factory=list)
    """First and last offsets of recorded events that are lost."""
    index_fault: str | None = None
    """Why the index of a sealed segment cannot be used, None if it can."""
    lost_bytes: int = 0
    torn_events: int = 0
    """Events in the torn end; none of them was synced."""
    next_offset: Offset = FIRST_OFFSET
    channels: dict[int, Channel] = field(default_factory=dict)
    """The channels in the segment's index; chunks define theirs as well."""
    schemas: dict[int, Schema] = field(default_factory=dict)
    """The schemas of verbatim messages in the segment's index."""

    def add_chunk(self, chunk: ChunkRef) -> None:
        """Add the next good chunk; offsets missing before it become a gap."""
        self.add_gap_until(chunk.first)
        self.chunks.append(chunk)
        self.next_offset = chunk.following

    def add_gap_until(self, offset: Offset) -> None:
        """Add the offsets from `next_offset` to before ``offset``, if any, as a gap."""
        if offset > self.next_offset:
            self.gaps.append((self.next_offset, Offset(offset - 1)))
            self.next_offset = offset


class SegmentFile:
    """An open segment file with the content of its head."""

    _fd = -1  # for __del__, should opening fail or be interrupted

    def __init__(self, path: Path, base: Offset) -> None:
        self.path = path
        self.base = base
        self.chunks: list[ChunkRef] = []
        self._fd = os.open(path, os.O_RDONLY)
        try:
            self.head, self.head_bytes = read_head(path, os.pread(self._fd, HEAD_BYTES, 0), base)
        except BaseException:
            self.close()
            raise
        self.log_id = self.head["log_id"]

    @property
    def next_offset(self) -> Offset:
        """The offset after the last event."""
        return self.chunks[-1].following if self.chunks else self.base

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

    def schemas_of(self, body: bytes) -> dict[int, Schema]:
        """The schemas of verbatim messages in a chunk's body, by id."""
        raise NotImplementedError

    def size(self) -> int:
        """Bytes of the file now."""
        return os.fstat(self._fd).st_size

    def close(self) -> None:
        """Close the file. May be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __del__(self) -> None:
        # Iterators share a segment with the reader that opened it; the last user closes the file.
        self.close()


def chunk_events(
    segment: SegmentFile, chunk: ChunkRef, start: Offset, end: Offset, keys: Collection[str] | None
) -> Iterator[Event]:
    """The events of one chunk with offsets from ``start`` to before ``end``, in order. Raises
    LogDamaged if the chunk's CRC, records or offsets are wrong."""
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
    formats = formats_of(channels, lambda: segment.schemas_of(body))
    base: int = segment.base
    expected: int = chunk.first
    for channel_id, sequence, log_ns, publish_ns, at, stop in _mcap.iter_messages(body):
        offset = base + sequence
        if offset != expected:
            raise BadRecord(f"offset {offset} where {expected} should be")
        expected = offset + 1
        if offset < start:
            continue
        if offset >= end:
            return
        key = names[channel_id]
        if keys is None or key in keys:
            if channel_id in formats:
                form = formats[channel_id]
                yield verbatim_event(Offset(offset), key, log_ns, publish_ns, body[at:stop], form)
                continue
            version = versions[channel_id]
            # No call of Offset for each event: reading would take 5 % longer.
            yield Event(offset, key, log_ns, publish_ns, body[at:stop], version)  # type: ignore[arg-type]
    if expected != chunk.following:
        raise BadRecord(f"the chunk ends before offset {expected}")


def formats_of(
    channels: Mapping[int, Channel], schemas: Callable[[], Mapping[int, Schema]]
) -> dict[int, MessageFormat]:
    """The formats of those of ``channels`` that carry verbatim messages, by id. ``schemas`` is
    called if there are any."""
    verbatim = {id_: channel for id_, channel in channels.items() if is_verbatim(channel)}
    if not verbatim:
        return {}
    known = schemas()
    return {
        id_: message_format(channel, known.get(channel.schema_id))
        for id_, channel in verbatim.items()
    }


def verbatim_event(
    offset: Offset, key: str, log_ns: int, publish_ns: int, payload: bytes, form: MessageFormat
) -> VerbatimEvent:
    """The event of a verbatim message."""
    return VerbatimEvent(offset, key, log_ns, publish_ns, payload, format=form)
