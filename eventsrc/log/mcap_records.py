"""Encode and decode the MCAP records of a log; the only module that imports the ``mcap`` package.

The package encodes records that appear once a file or once a chunk. Messages, chunk frames and the
commit mark are encoded here: the package takes 10 µs and several objects for each message, and
neither syncs nor says how far a file is intact.

Layout and numbers follow the MCAP specification (https://mcap.dev/spec). A record is an opcode
byte, a u64 length and its content, all little-endian.

The *commit mark* has opcode 0x80, from the range that the specification leaves to applications, so
other readers skip it. Content: u64 first offset and u64 next offset of the chunk before it, and the
CRC-32 of the record up to there, XORed with the random *mark seed* of its segment. Publishers do
not have the seed, so they cannot forge bytes that are read as a mark. The mark is written after its
chunk is synced.
"""

import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import TypeVar

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from eventsrc.base.machine import crc32
from eventsrc.envelope.model import Offset

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "mapfold"
LIBRARY = "mapfold"
MAX_EVENT_BYTES = 96 * 1024 * 1024
"""Limit for one payload. A rejected payload of 64 MiB takes 85 MiB as base64."""
MAX_GROUP_BYTES = 64 * 1024 * 1024
"""From this size on a group takes no further event."""
MAX_CHUNK_BYTES = 176 * 1024 * 1024
"""Limit for a chunk, compressed or not: a full group and one more event."""
MAX_SUMMARY_BYTES = 32 * 1024 * 1024
"""Limit for the index at the end of a sealed segment."""
MAX_MESSAGES = 1 << 20
"""Limit for the messages in one chunk."""
MAX_DEFINITIONS_BYTES = 16 * 1024 * 1024
"""Limit for all schemas and channels in a chunk or a summary, and for one metadata record."""

FRAME = struct.Struct("<BQ")
MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<BQQQQII")
_U64 = struct.Struct("<Q")
_MARK = struct.Struct("<BQQQ")
_CRC = struct.Struct("<I")

MESSAGE_HEAD = MESSAGE.size
PLAIN_CHUNK_HEAD = _CHUNK.size + _U64.size
ZSTD_CHUNK_HEAD = PLAIN_CHUNK_HEAD + 4
MARK_OPCODE = 0x80
MARK_BYTES = _MARK.size + _CRC.size
MARK_PATTERN = FRAME.pack(MARK_OPCODE, MARK_BYTES - FRAME.size)
ZSTD_PATTERN = struct.pack("<I", 4) + b"zstd"
ZSTD_PATTERN_AT = _CHUNK.size - 4
FOOTER_BYTES = FRAME.size + 20
TAIL_BYTES = FOOTER_BYTES + len(MAGIC)

_COPY_BELOW_BYTES = 1024 * 1024
"""Chunks below this size are read whole and their body is copied, which is faster."""
_COMPRESSION = zstandard.ZstdCompressionParameters.from_level(1, hash_log=12)
"""Base64 of floats has six bits a byte and little else to compress: home-1 shrinks to 0.699 of its
size at level 1, to 0.701 with a quarter of that level's table, which stays in the processor's
first cache and takes a tenth less time."""

Record = TypeVar("Record", bound=McapRecord)


class BadRecord(ValueError):
    """Bytes are not the record they should be. Inside ``eventsrc.log`` only."""


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """The frame of a chunk: position, sizes and CRC of its data.

    ``data_at`` counts from the start of the record; ``length`` is that of the whole record.
    """

    length: int
    data_at: int
    plain_size: int
    crc: int
    compressed: bool


def encode(record: McapRecord) -> bytes:
    """One record, encoded by the mcap package."""
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def metadata_with_crc(name: str, values: dict[str, str]) -> Metadata:
    """A metadata record with a CRC of its own, which MCAP does not provide."""
    return Metadata(name=name, metadata={**values, "crc32": _metadata_crc(values)})


def checked_metadata(record: Metadata) -> dict[str, str]:
    """The values of a `metadata_with_crc`. Raises BadRecord if the CRC is wrong."""
    values = dict(record.metadata)
    if values.pop("crc32", None) != _metadata_crc(values):
        raise BadRecord(f"metadata {record.name!r} does not match its CRC")
    return values


def _metadata_crc(values: dict[str, str]) -> str:
    text = "".join(f"{len(k)}:{k}{len(v)}:{v}" for k, v in sorted(values.items()))
    return f"{crc32(text.encode()):08x}"


def encode_message_head(channel: int, sequence: int, log: int, publish: int, size: int) -> bytes:
    """A message record up to its ``size`` payload bytes."""
    return MESSAGE.pack(Opcode.MESSAGE, 22 + size, channel, sequence, log, publish)


def renumber(head: bytes, by: int) -> bytes:
    """A message's head with ``by`` added to its sequence number."""
    opcode, length, channel, sequence, log, publish = MESSAGE.unpack(head)
    return MESSAGE.pack(opcode, length, channel, sequence + by, log, publish)


def new_compressor() -> zstandard.ZstdCompressor:
    """A compressor for `encode_chunk`; for one thread, and faster when reused."""
    return zstandard.ZstdCompressor(compression_params=_COMPRESSION)


def encode_chunk(
    compressor: zstandard.ZstdCompressor, body: bytes, first: int, last: int
) -> tuple[bytes, bytes]:
    """Head and data of a compressed chunk record around ``body``: whole schema, channel and message
    records, logged from ``first`` to ``last`` (ns). They are not joined, which would copy."""
    data = compressor.compress(body)
    head = _CHUNK.pack(
        Opcode.CHUNK,
        _CHUNK.size - FRAME.size + 4 + _U64.size + len(data),
        first,
        last,
        len(body),
        crc32(body),
        4,
    )
    return b"".join((head, b"zstd", _U64.pack(len(data)))), data


def encode_plain_chunk_head(size: int, crc: int, first_ns: int, last_ns: int) -> bytes:
    """An uncompressed chunk record up to the ``size`` bytes of its body."""
    length = PLAIN_CHUNK_HEAD - FRAME.size + size
    return _CHUNK.pack(Opcode.CHUNK, length, first_ns, last_ns, size, crc, 0) + _U64.pack(size)


def decode_chunk_head(data: bytes) -> ChunkHead:
    """The chunk frame at the start of ``data``; `ZSTD_CHUNK_HEAD` bytes are enough."""
    if len(data) < PLAIN_CHUNK_HEAD:
        raise BadRecord("cut short inside a chunk's head")
    opcode, length, _, _, size, crc, name_size = _CHUNK.unpack_from(data)
    if opcode != Opcode.CHUNK or name_size not in (0, 4):
        raise BadRecord("no chunk where one should start")
    if max(length, size) > MAX_CHUNK_BYTES:
        raise BadRecord(
            f"a chunk that declares {max(length, size):,} bytes, more than {MAX_CHUNK_BYTES:,}"
        )
    data_at = PLAIN_CHUNK_HEAD + name_size
    if len(data) < data_at:
        raise BadRecord("cut short inside a chunk's head")
    if name_size and data[_CHUNK.size : _CHUNK.size + 4] != b"zstd":
        raise BadRecord("chunk with an unknown compression")
    (data_size,) = _U64.unpack_from(data, _CHUNK.size + name_size)
    if length != 32 + name_size + 8 + data_size or (not name_size and data_size != size):
        raise BadRecord("a chunk's sizes contradict each other")
    return ChunkHead(FRAME.size + length, data_at, size, crc, bool(name_size))


def decode_chunk(record: bytes) -> bytes:
    """The body of a whole chunk record, its CRC checked."""
    head = decode_chunk_head(record)
    if len(record) < head.length:
        raise BadRecord("cut short inside a chunk")
    return _checked_body(head, record[head.data_at : head.length])


def read_chunk(read: Callable[[int, int], bytes], length: int, position: int) -> bytes:
    """The body of the chunk record of ``length`` bytes at ``position`` of a file, its CRC checked.
    ``read(length, position)`` reads from the file."""
    if length < _COPY_BELOW_BYTES:
        return decode_chunk(read(length, position))
    head = decode_chunk_head(read(ZSTD_CHUNK_HEAD, position))
    if head.length != length:
        raise BadRecord("a chunk of another length than its index says")
    return _checked_body(head, read(length - head.data_at, position + head.data_at))


def _checked_body(head: ChunkHead, body: bytes) -> bytes:
    if head.compressed:
        body = _decompress(body, head.plain_size)
    if len(body) != head.plain_size or crc32(body) != head.crc:
        raise BadRecord("a chunk does not match its CRC")
    return body


def _decompress(data: bytes, size: int) -> bytes:
    try:
        # The zstd frame declares its size, which is checked before memory is allocated.
        if zstandard.frame_content_size(data) != size:
            raise BadRecord("a chunk's compressed size is damaged")
        return zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError as error:
        raise BadRecord(f"a chunk cannot be decompressed: {error}") from None


def encode_message_index(channel: int, flat: list[int]) -> bytes:
    """The index of one channel's messages in a chunk; ``flat`` alternates log time and position."""
    content = struct.pack(f"<HI{len(flat)}Q", channel, 8 * len(flat), *flat)
    return FRAME.pack(Opcode.MESSAGE_INDEX, len(content)) + content


def encode_mark(first: Offset, following: Offset, seed: int) -> bytes:
    """The commit mark of a chunk that holds offsets ``first`` … ``following`` - 1."""
    mark = _MARK.pack(MARK_OPCODE, MARK_BYTES - FRAME.size, first, following)
    return mark + _CRC.pack(crc32(mark) ^ seed)


def decode_mark(data: bytes, seed: int) -> tuple[Offset, Offset]:
    """First and next offset of a commit mark made with ``seed``. Raises BadRecord."""
    if len(data) < MARK_BYTES:
        raise BadRecord("cut short inside a commit mark")
    opcode, _, first, following = _MARK.unpack_from(data)
    if opcode != MARK_OPCODE or seed_of_mark(data) != seed:
        raise BadRecord("no commit mark where one should be")
    return first, following


def seed_of_mark(mark: bytes) -> int:
    """The mark seed that ``mark`` was made with, if it is undamaged."""
    (crc,) = _CRC.unpack_from(mark, _MARK.size)
    return int(crc) ^ crc32(mark[: _MARK.size])


def iter_messages(body: bytes) -> Iterator[tuple[int, int, int, int, int, int]]:
    """Channel, sequence, log time, publish time, payload start and payload end in ``body`` of each
    message of a chunk. Raises BadRecord where a record does not fit."""
    at, size, unpack, message = 0, len(body), MESSAGE.unpack_from, int(Opcode.MESSAGE)
    try:
        while at < size:
            if body[at] == message:
                _, length, channel, sequence, log, publish = unpack(body, at)
                end = at + 9 + length
                if end > size or length < 22:
                    raise BadRecord("a message does not fit its chunk")
                yield channel, sequence, log, publish, at + 31, end
            else:
                end = at + 9 + _U64.unpack_from(body, at + 1)[0]
            at = end
    except struct.error:
        raise BadRecord("a record is cut short in a chunk") from None


def definitions(body: bytes, *, leading: bool = False) -> tuple[list[Schema], list[Channel]]:
    """The schema and channel records of a chunk's body; if ``leading``, only those before its first
    message."""
    schemas: list[Schema] = []
    channels: list[Channel] = []
    at = total = 0
    while at + FRAME.size <= len(body):
        opcode, length = FRAME.unpack_from(body, at)
        start, at = at + FRAME.size, at + FRAME.size + length
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            total += FRAME.size + length
            check_definitions(total)
        if opcode == Opcode.SCHEMA:
            schemas.append(decode_as(Schema, body[start:at]))
        elif opcode == Opcode.CHANNEL:
            channels.append(decode_as(Channel, body[start:at]))
        elif leading:
            break
    return schemas, channels


def check_definitions(total: int) -> None:
    """Raise BadRecord if schemas and channels, which are kept in memory, take too many bytes."""
    if total > MAX_DEFINITIONS_BYTES:
        raise BadRecord(f"schemas and channels of more than {MAX_DEFINITIONS_BYTES:,} bytes")


def records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of the records in ``data``. Raises BadRecord where one is cut short."""
    at = 0
    while at < len(data):
        if at + FRAME.size > len(data):
            raise BadRecord("cut short inside a record's frame")
        opcode, length = FRAME.unpack_from(data, at)
        start, at = at + FRAME.size, at + FRAME.size + length
        if at > len(data):
            raise BadRecord("cut short inside a record")
        yield opcode, data[start:at]


def decode_as(kind: type[Record], content: bytes) -> Record:
    """One record, decoded by the mcap package. Raises BadRecord for any of its errors."""
    stream = ReadDataStream(BytesIO(content))
    try:
        record: Record = kind.read(stream)  # type: ignore[attr-defined]
    except (McapError, struct.error, UnicodeDecodeError, ValueError) as error:
        raise BadRecord(f"{kind.__name__} cannot be read: {error}") from None
    return record


def encode_all(items: Iterable[McapRecord]) -> bytes:
    """Encoded records, joined."""
    return b"".join(encode(item) for item in items)


__all__ = [
    "Channel",
    "ChunkIndex",
    "DataEnd",
    "Footer",
    "Header",
    "Message",
    "MessageIndex",
    "Metadata",
    "MetadataIndex",
    "Opcode",
    "Schema",
    "Statistics",
    "SummaryOffset",
]
