"""What can still be read of an active segment, whatever happened to its bytes.

The file is a row of chunks and commit marks. A chunk counts when its CRC holds and its sequence
numbers continue. Where no good chunk stands, the next one is searched for: close by (a damaged
mark or head), else behind the next commit mark. Then:

* Bytes at the end that no good chunk and no commit mark follows are *torn*: the write that a crash
  cut short. They were never synced, so nobody was told that they are recorded.
* Everything else that cannot be read is *rot*: a mark or a chunk behind it proves that it was
  synced once. Its offsets are known from what stands around it, and named as a gap.
"""

from dataclasses import dataclass, field
from pathlib import Path

from eventsrc.errors import LogDamaged, NotALog

from . import _mcap
from ._bytes import FileBytes
from ._head import HEAD_BYTES, read_head
from ._mcap import BadRecord, Channel
from .segment import ChunkRef

_NEAR = 4096
_IN_A_CHUNK = (_mcap.Opcode.SCHEMA, _mcap.Opcode.CHANNEL, _mcap.Opcode.MESSAGE)


@dataclass(slots=True)
class Scan:
    """The good chunks of a segment and what is between and behind them."""

    base: int
    log_id: str | None
    chunks: list[ChunkRef] = field(default_factory=list)
    gaps: list[tuple[int, int]] = field(default_factory=list)
    """First and last offset of events that were recorded once and are gone."""
    index_fault: str | None = None
    """Why the index of a sealed segment cannot be used, if so."""
    lost_bytes: int = 0
    torn_events: int = 0
    """Events that had begun to be written in the torn end; none of them was synced."""
    next_offset: int = 0
    channels: dict[int, Channel] = field(default_factory=dict)
    """What the segment's index says of channels; its chunks name their own as well."""

    def take(self, chunk: ChunkRef) -> None:
        """The next good chunk; what lies before it is a gap."""
        self.gap_up_to(chunk.first)
        self.chunks.append(chunk)
        self.next_offset = chunk.following

    def gap_up_to(self, offset: int) -> None:
        """Offsets before ``offset`` that no good chunk holds are gone."""
        if offset > self.next_offset:
            self.gaps.append((self.next_offset, offset - 1))
            self.next_offset = offset


def chunk_extent(data: FileBytes, at: int, scan: Scan) -> tuple[int, int, int]:
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
    return head.length, scan.base + first, scan.base + following


def scan_active(path: Path, base: int) -> Scan:
    """Look at every byte of an active segment."""
    with FileBytes.of(path) as data:
        return _Scanner(path, base, data).run()


class _Scanner:
    def __init__(self, path: Path, base: int, data: FileBytes) -> None:
        self._path = path
        self._data = data
        self._at = 0
        self._promised = base
        self.result = Scan(base, None, next_offset=base)

    def run(self) -> Scan:
        self._read_head()
        while self._at < len(self._data):
            if not self._take_chunk(self._at):
                self._resync()
        self.result.gap_up_to(self._promised)
        return self.result

    def _read_head(self) -> None:
        try:
            head, self._at = read_head(self._path, self._data[:HEAD_BYTES], self.result.base)
            self.result.log_id = head["log_id"]
        except (LogDamaged, NotALog):
            self._resync()

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
        self._take_mark()
        return True

    def _take_mark(self) -> None:
        try:
            _, following = _mcap.decode_mark(self._data[self._at : self._at + _mcap.MARK_BYTES])
        except BadRecord:
            return
        self._promised = max(self._promised, following)
        self._at += _mcap.MARK_BYTES

    def _resync(self) -> None:
        """Move to where reading can go on: a good chunk close by, behind a mark, or the end."""
        start = self._at
        self._at = self._near_chunk(start) or self._after_mark(start) or len(self._data)
        self.result.lost_bytes += self._at - start
        if self._at == len(self._data):
            self.result.torn_events += _count_begun(self._data, start)

    def _near_chunk(self, start: int) -> int | None:
        at = start
        while (at := self._data.find(b"\x06", at + 1, start + _NEAR)) >= 0:
            try:
                chunk_extent(self._data, at, self.result)
            except BadRecord:
                continue
            return at
        return None

    def _after_mark(self, start: int) -> int | None:
        at = start - 1
        while (at := self._data.find(_mcap.MARK_PATTERN, at + 1)) >= 0:
            try:
                _, following = _mcap.decode_mark(self._data[at : at + _mcap.MARK_BYTES])
            except BadRecord:
                continue
            self._promised = max(self._promised, following)
            return at + _mcap.MARK_BYTES
        return None


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
