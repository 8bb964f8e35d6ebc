"""An open segment file: where each chunk is, and the events of one chunk.

An active segment, growing or left over from a crash, has no index: its chunk heads and commit marks
(80 bytes a commit) are read once, and later only those that have been added. How far it was read
follows from the chunks, which are added one by one, so that an exception at any moment, such as
that of Ctrl-C, leaves it right.
"""

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.model import FIRST_OFFSET, Offset

from . import mcap_records as _mcap
from .channels import envelope_version, is_verbatim, message_format
from .event import Event, MessageFormat, VerbatimEvent
from .file_bytes import DamagedBytes, FileBytes, skip_damaged
from .format import HEAD_BYTES, SEALED, mark_seed, read_head, segment_path
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


class ActiveFile(SegmentFile):
    """An active segment up to its last commit mark."""

    def __init__(self, path: Path, base: Offset) -> None:
        super().__init__(path, base)
        self._seed = mark_seed(self.head)
        try:
            self.refresh()
        except BaseException:
            self.close()
            raise

    @property
    def position(self) -> int:
        """The byte after the last commit mark that was read."""
        if not self.chunks:
            return self.head_bytes
        last = self.chunks[-1]
        return last.position + last.length + _mcap.MARK_BYTES

    def refresh(self) -> Offset:
        """Read the commit marks added since the last call; return the next offset."""
        try:
            while self._read_commit():
                pass
        except BadRecord:
            # A chunk that is being written, a torn end, or damage, which `damaged_end` finds.
            pass
        return self.next_offset

    def _read_commit(self) -> bool:
        position = self.position
        head_bytes = os.pread(self._fd, _mcap.PLAIN_CHUNK_HEAD, position)
        if len(head_bytes) < _mcap.PLAIN_CHUNK_HEAD:
            return False
        head = _mcap.decode_chunk_head(head_bytes)
        mark = os.pread(self._fd, _mcap.MARK_BYTES, position + head.length)
        first, following = _mcap.decode_mark(mark, self._seed)
        if first != self.next_offset:
            raise BadRecord("a commit mark contradicts the one before it")
        self.chunks.append(ChunkRef(position, head.length, first, following))
        return True

    def was_replaced(self) -> bool:
        """Whether this segment is another file now: the sealed one, or a new active one."""
        try:
            now = self.path.stat()
        except FileNotFoundError:
            return segment_path(self.path.parent, self.base, SEALED).exists()
        return now.st_ino != os.fstat(self._fd).st_ino

    def damaged_end(self) -> Unreadable | None:
        """The durable events after the last readable commit, None if there are none.

        No commit mark follows bytes that were never synced, such as a torn end. So where a mark
        follows, recorded bytes are damaged.
        """
        while self.position < self.size():
            with FileBytes(self._fd, self.position) as rest:
                recorded_end = self._recorded_end_in(rest)
            before = self.next_offset
            if self.refresh() == before:  # else a writer has added commits meanwhile
                if recorded_end <= before:
                    return None
                return Unreadable(
                    before, Offset(recorded_end - 1), f"damaged at byte {self.position}"
                )
        return None

    def _recorded_end_in(self, rest: FileBytes) -> Offset:
        """The end of what was recorded, by the commit marks found in the unreadable ``rest``."""
        damaged = DamagedBytes(0, self.next_offset)
        at, recorded_end = 0, self.next_offset
        while at < len(rest):
            at, marked_end = skip_damaged(rest, at, damaged, self._seed)
            recorded_end = max(recorded_end, marked_end)
        return recorded_end

    def channels_of(self, body: bytes) -> dict[int, Channel]:
        """The channels of a chunk by id, from the records before its first message."""
        _, channels = _mcap.definitions(body, leading=True)
        return {channel.id: channel for channel in channels}

    def schemas_of(self, body: bytes) -> dict[int, Schema]:
        """The schemas of a chunk by id, from the records before its first message."""
        schemas, _ = _mcap.definitions(body, leading=True)
        return {schema.id: schema for schema in schemas}
