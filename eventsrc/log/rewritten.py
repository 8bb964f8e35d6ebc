"""Read segments that another program has rewritten, as `mcap sort` does.

Such a file has other chunks in another order. But its metadata still names the log and the base,
and each message has its sequence number, so every event in it has its right offset. It is read by
`foreign_mcap`, with the limits of our own segments. What cannot be read, or exceeds a segment,
counts as lost bytes.
"""

import struct
from bisect import bisect_right
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

from eventsrc.envelope.model import FIRST_OFFSET, Offset

from . import mcap_records as _mcap
from .foreign_mcap import ForeignDamage, ForeignRecord, foreign_records
from .format import is_metadata_of
from .mcap_records import FRAME, BadRecord, Header, Opcode
from .sealed_segment import SEAL_METADATA
from .segment import ChunkRef, Scan

_MAX_BYTES: Final = 1 << 28
"""Limit for the messages of one file, which are held in memory; a segment holds a quarter of that,
unless single events are larger."""
_OVERHEAD_BYTES: Final = 256
"""Memory of a message besides its bytes."""
_RUN_BYTES: Final = 1 << 24
"""Size of the chunks that are made of the messages."""
_OPCODES: Final = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.METADATA)
_SEQUENCES: Final = 1 << 32
_HEAD: Final = struct.Struct("<HIQQ")
"""The head of a message: channel, sequence number, log and publish time."""


def is_rewritten(data: bytes) -> bool:
    """Whether the MCAP file that begins with ``data`` was written by another program."""
    try:
        opcode, content = next(_mcap.records(data[len(_mcap.MAGIC) :]))
        return opcode == Opcode.HEADER and _mcap.decode_as(Header, content).library != _mcap.LIBRARY
    except (BadRecord, StopIteration):
        return False


def add_messages(path: Path, scan: Scan, following: Offset | None) -> None:
    """Add to ``scan`` every message of the file that is in none of its chunks. Messages from offset
    ``following`` on, where the next segment begins, are left out."""
    messages = _Messages(scan, following)
    unread = 0
    with path.open("rb") as file:
        size = path.stat().st_size
        try:
            for record in foreign_records(file, _OPCODES, _mcap.MAX_CHUNK_BYTES):
                if not messages.add(record):
                    unread = size - record.at
                    break
        except ForeignDamage as error:
            unread = size - error.at
    messages.merge()
    scan.lost_bytes, scan.torn_events = unread, 0


class _Messages:
    """The messages of a file by offset, and the schemas and channels that they need."""

    def __init__(self, scan: Scan, following: Offset | None) -> None:
        self._scan = scan
        self._end = Offset(scan.base + _SEQUENCES) if following is None else following
        self._known = list(scan.chunks)
        self._starts = [chunk.first for chunk in self._known]
        self._channels: set[int] = set()
        self._definitions: dict[bytes, None] = {}
        self._messages: dict[Offset, bytes] = {}
        self._definition_bytes = self._message_bytes = 0

    def add(self, record: ForeignRecord) -> bool:
        """Add a record; False if it cannot be read or is over a limit."""
        opcode, content = record.opcode, record.content
        if opcode == Opcode.MESSAGE:
            return self._add_message(content)
        try:
            _mcap.check_definitions(len(content))
            if opcode == Opcode.METADATA:
                metadata = _mcap.decode_as(_mcap.Metadata, content)
                self._scan.add_gap_until(Offset(self._scan.base + _event_count_of_seal(metadata)))
                return True
            if opcode == Opcode.CHANNEL:
                self._channels.add(_mcap.decode_as(_mcap.Channel, content).id)
            else:
                _mcap.decode_as(_mcap.Schema, content)
            return self._add_definition(_framed(opcode, content))
        except BadRecord:
            return False

    def _add_definition(self, record: bytes) -> bool:
        if record not in self._definitions:
            self._definition_bytes += len(record)
            _mcap.check_definitions(self._definition_bytes)
            self._definitions[record] = None
        return True

    def _add_message(self, content: bytes) -> bool:
        if len(content) < _HEAD.size:
            return False
        channel, sequence, _, _ = _HEAD.unpack_from(content)
        offset = Offset(self._scan.base + sequence)
        wanted = offset < self._end and offset not in self._messages and not self._has(offset)
        if wanted and channel in self._channels:
            self._message_bytes += len(content) + _OVERHEAD_BYTES
            if self._message_bytes > _MAX_BYTES:
                return False
            self._messages[offset] = _framed(Opcode.MESSAGE, content)
        return True

    def _has(self, offset: Offset) -> bool:
        index = bisect_right(self._starts, offset) - 1
        return index >= 0 and offset < self._known[index].following

    def merge(self) -> None:
        """Make chunks of the messages and put them between the good chunks of the scan."""
        scan = self._scan
        definitions = b"".join(self._definitions)
        chunks = list(self._known)
        for first, run in _runs(self._messages):
            size = len(definitions) + sum(map(len, run))
            body = partial(b"".join, [definitions, *run])
            chunks.append(ChunkRef(0, size, first, Offset(first + len(run)), body=body))
        end = scan.next_offset
        scan.chunks, scan.gaps, scan.next_offset = [], [], scan.base
        for chunk in sorted(chunks, key=lambda chunk: chunk.first):
            scan.add_chunk(chunk)
        scan.add_gap_until(end)


def _framed(opcode: int, content: bytes) -> bytes:
    return FRAME.pack(opcode, len(content)) + content


def _event_count_of_seal(record: _mcap.Metadata) -> int:
    """How many events the segment held when it was sealed; 0 if this record is not its seal."""
    try:
        if is_metadata_of(SEAL_METADATA, record.name):
            return int(_mcap.checked_metadata(record)["chunk_edges"].rsplit(",", 1)[-1])
    except (KeyError, ValueError):
        pass
    return 0


def _runs(messages: dict[Offset, bytes]) -> Iterator[tuple[Offset, list[bytes]]]:
    """Messages of consecutive offsets, some mebibytes at a time, with the first offset of each."""
    first, size = FIRST_OFFSET, 0
    run: list[bytes] = []
    for offset in sorted(messages):
        if run and (offset != first + len(run) or size > _RUN_BYTES):
            yield first, run
            run, size = [], 0
        if not run:
            first = offset
        run.append(messages[offset])
        size += len(messages[offset])
    if run:
        yield first, run
