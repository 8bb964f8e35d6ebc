"""What can still be read of an active segment, whatever happened to its bytes.

The file is a row of chunks and commit marks. A chunk counts when its CRC holds and its sequence
numbers continue. Where no good chunk stands, `_resync` says where reading can go on. Then:

* Bytes at the end that no good chunk and no commit mark follows are *torn*: the write that a crash
  cut short. They were never synced, so nobody was told that they are recorded.
* Everything else that cannot be read is *rot*: a mark or a chunk behind it proves that it was
  synced once. Its offsets are known from what stands around it, and named as a gap.

Events straight from a chunk, without any index: what a scan found good.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.errors import LogDamaged, NotALog

from . import mcap_records as _mcap
from .durable_files import FileBytes
from .event import Event
from .format import HEAD_BYTES, WrongPlace, envelope_version, mark_seed, read_head
from .mcap_records import BadRecord, Channel
from .resync import Stretch, resume
from .rewritten import is_rewritten, take_messages
from .segment import ChunkRef

_IN_A_CHUNK = (_mcap.Opcode.SCHEMA, _mcap.Opcode.CHANNEL, _mcap.Opcode.MESSAGE)
_MOST_TRIED: Final = 64
"""So many times the size of a file is spent on what seems to be a chunk in it, at most; a sparse
file may be of any size."""


@dataclass(slots=True)
class Scan:
    """The good chunks of a segment and what is between and behind them."""

    base: Offset
    log_id: str | None
    chunks: list[ChunkRef] = field(default_factory=list)
    gaps: list[tuple[Offset, Offset]] = field(default_factory=list)
    """First and last offset of events that were recorded once and are gone."""
    index_fault: str | None = None
    """Why the index of a sealed segment cannot be used, if so."""
    lost_bytes: int = 0
    torn_events: int = 0
    """Events that had begun to be written in the torn end; none of them was synced."""
    next_offset: Offset = FIRST_OFFSET
    rewritten: bool = False
    """Whether another program has written the file that it is in now."""
    channels: dict[int, Channel] = field(default_factory=dict)
    """What the segment's index says of channels; its chunks name their own as well."""

    def take(self, chunk: ChunkRef) -> None:
        """The next good chunk; what lies before it is a gap."""
        self.gap_up_to(chunk.first)
        self.chunks.append(chunk)
        self.next_offset = chunk.following

    def gap_up_to(self, offset: Offset) -> None:
        """Offsets before ``offset`` that no good chunk holds are gone."""
        if offset > self.next_offset:
            self.gaps.append((self.next_offset, Offset(offset - 1)))
            self.next_offset = offset


def chunk_extent(data: FileBytes, at: int, scan: Scan) -> tuple[int, Offset, Offset]:
    """Length, first and next offset of the chunk at ``at``; BadRecord unless all of it is good."""
    head = _mcap.decode_chunk_head(data[at : at + _mcap.ZSTD_CHUNK_HEAD])
    if at + head.length > len(data):
        raise BadRecord("cut short inside a chunk")
    body = _mcap.read_chunk(lambda length, place: data[place : place + length], head.length, at)
    channels = {*scan.channels, *(channel.id for channel in _mcap.definitions(body)[1])}
    first = following = -1
    for channel, sequence, _, _, _, _ in _mcap.walk(body):
        if channel not in channels:
            raise BadRecord(f"a chunk uses channel {channel}, which nothing defines")
        if first < 0:
            first = following = sequence
        if sequence != following or following - first >= _mcap.MAX_MESSAGES:
            raise BadRecord("a chunk's sequence numbers have holes, or are too many")
        following += 1
    if first < 0:
        raise BadRecord("a chunk without any message")
    return head.length, Offset(scan.base + first), Offset(scan.base + following)


def scan_active(path: Path, base: Offset, following: Offset | None = None) -> Scan:
    """Look at every byte of an active segment; ``following`` is the base of the next one, if there
    is one. Raises WrongPlace for a segment of another base."""
    with FileBytes.of(path) as data:
        scan = _Scanner(path, base, data).run()
        scan.rewritten = is_rewritten(data[:HEAD_BYTES])
    if scan.rewritten:
        take_messages(path, scan, following)
    return scan


class _Row(NamedTuple):
    """Bytes ``start`` to ``end`` are good chunks and their marks, made with ``seed``."""

    start: int
    end: int
    seed: int | None


class _Scanner:
    def __init__(self, path: Path, base: Offset, data: FileBytes) -> None:
        self._path = path
        self._data = data
        self._at = 0
        self._good_end = 0
        self._promised = base
        self._seed: int | None = None
        self.result = Scan(base, None, next_offset=base)

    def run(self) -> Scan:
        self._read_head()
        while self._at < len(self._data):
            if not self._take_chunk(self._at):
                self._pass_by()
        self.result.gap_up_to(self._promised)
        return self.result

    def _read_head(self) -> None:
        try:
            head, self._at = read_head(self._path, self._data[:HEAD_BYTES], self.result.base)
        except WrongPlace:
            raise
        except (LogDamaged, NotALog):
            self._find_first_chunk()
        else:
            self.result.log_id = head["log_id"]
            self._seed = mark_seed(head)
        self._good_end = self._at

    def _find_first_chunk(self) -> None:
        """Where the head of the file is damaged, the row of good chunks that ends last tells the
        seed, for nothing in a chunk ends behind it; reading starts with the first row of that seed.
        """
        rows = list(self._rows())
        if rows:
            self._seed = max(rows, key=lambda row: row.end).seed
        starts = [row.start for row in rows if row.seed == self._seed]
        self._at = min(starts, default=len(self._data))
        self._lose(0)

    def _rows(self) -> Iterator[_Row]:
        """Good chunks with their marks, one directly behind the other, wherever they stand."""
        at = -1
        effort = _MOST_TRIED * min(len(self._data), _mcap.MAX_CHUNK_BYTES)
        while effort > 0 and (at := self._data.find(b"\x06", at + 1)) >= 0:
            try:
                head = _mcap.decode_chunk_head(self._data[at : at + _mcap.PLAIN_CHUNK_HEAD])
            except BadRecord:
                continue
            effort -= head.length if at + head.length <= len(self._data) else 0
            row = self._row_at(at)
            if row is not None:
                yield row
                at = row.end - 1

    def _row_at(self, start: int) -> _Row | None:
        seed: int | None = None
        end = at = start
        while True:
            try:
                length, first, following = chunk_extent(self._data, at, self.result)
            except BadRecord:
                return _Row(start, end, seed) if end > start else None
            end = at = at + length
            found = self._seed_of(at, first, following)
            if found is None or seed not in (None, found):
                return _Row(start, end, seed)
            seed = found
            at += _mcap.MARK_BYTES

    def _seed_of(self, at: int, first: Offset, following: Offset) -> int | None:
        """The seed of the mark at byte ``at``, if it is that of a chunk of these offsets."""
        mark = self._data[at : at + _mcap.MARK_BYTES]
        if len(mark) < _mcap.MARK_BYTES:
            return None
        seed = _mcap.seed_of_mark(mark)
        return seed if mark == _mcap.encode_mark(first, following, seed) else None

    def _take_chunk(self, at: int) -> bool:
        """Accept the chunk at ``at`` and its mark; False when none is there."""
        try:
            length, first, following = chunk_extent(self._data, at, self.result)
        except BadRecord:
            return False
        if first < self.result.next_offset:
            return False
        self.result.take(ChunkRef(at, length, first, following))
        self._at = at + length
        if self._seed is not None and self._seed_of(self._at, first, following) == self._seed:
            self._at += _mcap.MARK_BYTES
        self._good_end = self._at
        return True

    def _pass_by(self) -> None:
        """Move on from a record that cannot be read."""
        start = self._at
        stretch = Stretch(self._good_end, self.result.next_offset)
        self._at, promised = resume(self._data, start, stretch, self._seed)
        self._promised = max(self._promised, promised)
        self._lose(start)

    def _lose(self, start: int) -> None:
        self.result.lost_bytes += self._at - start
        if self._at == len(self._data):
            self.result.torn_events += _count_begun(self._data, start)


def _count_begun(data: FileBytes, torn: int) -> int:
    """How many events a chunk that is torn had begun; nothing of them can be trusted, their number
    may."""
    at, count = torn + _mcap.PLAIN_CHUNK_HEAD, 0
    while at + _mcap.FRAME.size <= len(data):
        opcode, length = _mcap.FRAME.unpack(data[at : at + _mcap.FRAME.size])
        if opcode not in _IN_A_CHUNK:
            break
        count += opcode == _mcap.Opcode.MESSAGE
        at += _mcap.FRAME.size + length
    return count


def read_body(fd: int, chunk: ChunkRef) -> bytes:
    """The body of a chunk that has been checked already."""
    if chunk.body is not None:
        return chunk.body()
    return _mcap.read_chunk(partial(os.pread, fd), chunk.length, chunk.position)


def raw_events(fd: int, scan: Scan, chunk: ChunkRef) -> Iterator[Event]:
    """The events of a chunk of ``scan``."""
    body = read_body(fd, chunk)
    _, channels = _mcap.definitions(body)
    known = {
        channel.id: (channel.topic, envelope_version(channel))
        for channel in (*scan.channels.values(), *channels)
    }
    for id_, sequence, log_ns, stamp_ns, at, stop in _mcap.walk(body):
        key, version = known[id_]
        yield Event(Offset(scan.base + sequence), key, log_ns, stamp_ns, body[at:stop], version)
