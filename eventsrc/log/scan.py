"""Scan a segment, damaged or not, for its good chunks; read the events of a scan.

Every chunk is decompressed, and its CRC and sequence numbers are checked. Those of a sealed segment
are found by its index or, if that is damaged, by searching the bytes for chunks.

An active segment is a sequence of chunks and commit marks. A chunk is good if its CRC holds and its
sequence numbers continue. Where none is, `skip_damaged` says where reading can go on. Then:

* Bytes at the end that no good chunk and no commit mark follow are *torn*: a write that a crash cut
  short. They were never synced, so their events were never recorded.
* Everything else that cannot be read is damage to recorded bytes (*rot*): a mark or a chunk after
  it proves that it was synced. Its offsets are known from its neighbours and reported as a gap.
"""

import contextlib
import os
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.base.errors import LogDamaged, NotALog
from eventsrc.envelope.model import Offset

from . import mcap_records as _mcap
from .channels import envelope_version
from .event import Event
from .file_bytes import DamagedBytes, FileBytes, skip_damaged
from .format import HEAD_BYTES, WrongPlace, end_in, mark_seed, read_head
from .mcap_records import BadRecord, Metadata
from .sealed_segment import SEAL_METADATA, SealedFile, sealed_edges
from .segment import ChunkRef, Scan, formats_of, verbatim_event

_CHUNK_OPCODES = (_mcap.Opcode.SCHEMA, _mcap.Opcode.CHANNEL, _mcap.Opcode.MESSAGE)
_MAX_PASSES: Final = 64
"""Limit for the search of a first chunk: bytes checked, in multiples of the file's size (or of the
largest chunk: a sparse file may be of any size)."""


def check_chunk(data: FileBytes, at: int, scan: Scan) -> tuple[int, Offset, Offset]:
    """Length, first and next offset of the chunk at ``at``; BadRecord unless all of it is good."""
    head = _mcap.decode_chunk_head(data[at : at + _mcap.ZSTD_CHUNK_HEAD])
    if at + head.length > len(data):
        raise BadRecord("cut short inside a chunk")
    body = _mcap.read_chunk(lambda length, place: data[place : place + length], head.length, at)
    channels = {*scan.channels, *(channel.id for channel in _mcap.definitions(body)[1])}
    first = following = -1
    for channel, sequence, _, _, _, _ in _mcap.iter_messages(body):
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


def scan_active(path: Path, base: Offset) -> Scan:
    """Scan every byte of an active segment. Raises WrongPlace for a segment of another base."""
    with FileBytes.of(path) as data:
        return _Scanner(path, base, data).run()


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
        self._recorded_end = base
        self._seed: int | None = None
        self.result = Scan(base, None, next_offset=base)

    def run(self) -> Scan:
        self._read_head()
        while self._at < len(self._data):
            if not self._take_chunk(self._at):
                self._skip_damaged()
        self.result.add_gap_until(self._recorded_end)
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
        """Find where to start if the head of the file is damaged. The mark seed is that of the row
        of good chunks that ends last: chunks inside a payload end before it. Reading starts with
        the first row of that seed."""
        rows = list(self._find_rows())
        if rows:
            self._seed = max(rows, key=lambda row: row.end).seed
        starts = [row.start for row in rows if row.seed == self._seed]
        self._at = min(starts, default=len(self._data))
        self._count_lost(0)

    def _find_rows(self) -> Iterator[_Row]:
        """Every row of adjacent good chunks and marks in the file."""
        at = -1
        effort = _MAX_PASSES * min(len(self._data), _mcap.MAX_CHUNK_BYTES)
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
                length, first, following = check_chunk(self._data, at, self.result)
            except BadRecord:
                return _Row(start, end, seed) if end > start else None
            end = at = at + length
            found = self._seed_of(at, first, following)
            if found is None or seed not in (None, found):
                return _Row(start, end, seed)
            seed = found
            at += _mcap.MARK_BYTES

    def _seed_of(self, at: int, first: Offset, following: Offset) -> int | None:
        """The seed of the mark at byte ``at``, None unless it marks a chunk of these offsets."""
        mark = self._data[at : at + _mcap.MARK_BYTES]
        if len(mark) < _mcap.MARK_BYTES:
            return None
        seed = _mcap.seed_of_mark(mark)
        return seed if mark == _mcap.encode_mark(first, following, seed) else None

    def _take_chunk(self, at: int) -> bool:
        """Accept the chunk at byte ``at`` and its mark; False if there is no good chunk."""
        try:
            length, first, following = check_chunk(self._data, at, self.result)
        except BadRecord:
            return False
        if first < self.result.next_offset:
            return False
        self.result.add_chunk(ChunkRef(at, length, first, following))
        self._at = at + length
        if self._seed is not None and self._seed_of(self._at, first, following) == self._seed:
            self._at += _mcap.MARK_BYTES
        self._good_end = self._at
        return True

    def _skip_damaged(self) -> None:
        """Skip a record that cannot be read."""
        start = self._at
        damaged = DamagedBytes(self._good_end, self.result.next_offset)
        self._at, recorded_end = skip_damaged(self._data, start, damaged, self._seed)
        self._recorded_end = max(self._recorded_end, recorded_end)
        self._count_lost(start)

    def _count_lost(self, start: int) -> None:
        self.result.lost_bytes += self._at - start
        if self._at == len(self._data):
            self.result.torn_events += _count_torn_events(self._data, start)


def _count_torn_events(data: FileBytes, torn: int) -> int:
    """How many events of a torn chunk were begun. Their content cannot be checked."""
    at, count = torn + _mcap.PLAIN_CHUNK_HEAD, 0
    while at + _mcap.FRAME.size <= len(data):
        opcode, length = _mcap.FRAME.unpack(data[at : at + _mcap.FRAME.size])
        if opcode not in _CHUNK_OPCODES:
            break
        count += opcode == _mcap.Opcode.MESSAGE
        at += _mcap.FRAME.size + length
    return count


def read_body(fd: int, chunk: ChunkRef) -> bytes:
    """The body of a chunk that a scan found good."""
    if chunk.body is not None:
        return chunk.body()
    return _mcap.read_chunk(partial(os.pread, fd), chunk.length, chunk.position)


def scanned_events(fd: int, scan: Scan, chunk: ChunkRef) -> Iterator[Event]:
    """The events of a chunk of ``scan``."""
    body = read_body(fd, chunk)
    schemas, channels = _mcap.definitions(body)
    known = scan.channels | {channel.id: channel for channel in channels}
    names = {id_: (channel.topic, envelope_version(channel)) for id_, channel in known.items()}
    formats = formats_of(known, lambda: scan.schemas | {schema.id: schema for schema in schemas})
    for id_, sequence, log_ns, stamp_ns, at, stop in _mcap.iter_messages(body):
        key, version = names[id_]
        offset, payload = Offset(scan.base + sequence), body[at:stop]
        if id_ in formats:
            yield verbatim_event(offset, key, log_ns, stamp_ns, payload, formats[id_])
        else:
            yield Event(offset, key, log_ns, stamp_ns, payload, version)


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
