"""Read MCAP files that other programs wrote: their messages or records, in file order.

The mcap package allocates as much memory as a file declares, and a file of 98 kB can declare, and
hold, gigabytes. So records are read here, and every declared size (of a record, a chunk, its
compressed content) is checked against a limit before memory is allocated. Other records are skipped
in pieces, and so are messages over the limit, in a chunk or not, of which an `Excerpt` is made.
"""

import io
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import BinaryIO, Final, NamedTuple, Protocol, cast

import zstandard
from lz4.frame import LZ4FrameDecompressor, LZ4FrameFile

from eventsrc.base.machine import crc32
from eventsrc.envelope.system_events import MAX_KEPT_BYTES, Excerpt

from . import mcap_records as _mcap
from .channels import ENVELOPE_VERSION_KEY, envelope_version, is_verbatim, message_format
from .event import MessageFormat
from .mcap_records import FRAME, MAGIC, BadRecord, Channel, Opcode, Schema

MAX_FOREIGN_BYTES: Final = MAX_KEPT_BYTES
"""Limit for what is held of a chunk, compressed or not, and for a message."""
_MAX_STREAMED_BYTES: Final = 4 * 1024 * 1024 * 1024
"""Limit for a chunk that is read in pieces, which takes time only."""
_HEAD = struct.Struct("<QQQII")
"""First and last log time, uncompressed size and its CRC, length of the compression's name."""
_U64 = struct.Struct("<Q")


def check_size(what: str, size: int, max_bytes: int) -> None:
    """Raise BadRecord if the ``size`` that a record or chunk (``what``) declares is too large."""
    if size > max_bytes:
        raise BadRecord(
            f"a {what} declares {size:,} bytes, more than {max_bytes:,} are read; if that "
            "is right, write the file again in smaller chunks (`mcap compress --chunk-size`)"
        )


def decode_foreign_chunk(content: bytes, max_bytes: int) -> bytes:
    """The decompressed records of a chunk, from the content of its chunk record. Raises BadRecord,
    also for more than ``max_bytes``."""
    try:
        _, _, size, crc, name_size = _HEAD.unpack_from(content)
        data_at = _HEAD.size + name_size + _U64.size
        (data_size,) = _U64.unpack_from(content, _HEAD.size + name_size)
    except struct.error:
        raise BadRecord("a chunk's head is cut short") from None
    name = content[_HEAD.size : _HEAD.size + name_size]
    check_size("chunk", size, max_bytes)
    if data_at + data_size > len(content):
        raise BadRecord("a chunk's content is longer than the chunk")
    body = _decompress(name, content[data_at : data_at + data_size], size)
    if len(body) != size:
        than = "more" if len(body) > size else "less"
        raise BadRecord(f"a chunk holds {than} than the {size:,} bytes that it declares")
    if crc and crc32(body) != crc:
        raise BadRecord("a chunk does not match its CRC")
    return body


def _decompress(name: bytes, data: bytes, size: int) -> bytes:
    """The decompressed ``data``, cut off after ``size`` + 1 bytes."""
    with _raising_bad_record():
        match name:
            case b"":
                return data[: size + 1]
            case b"zstd":
                return _decompress_zstd(data, size)
            case b"lz4":
                return bytes(LZ4FrameDecompressor().decompress(data, size + 1))
    raise _unknown_compression(name)


@contextmanager
def _raising_bad_record() -> Iterator[None]:
    try:
        yield
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise BadRecord(f"a chunk cannot be decompressed: {error}") from None


def _unknown_compression(name: bytes) -> BadRecord:
    return BadRecord(f"a chunk is compressed with {name[:32]!r}; zstd and lz4 are read")


def _decompress_zstd(data: bytes, size: int) -> bytes:
    decompressor = zstandard.ZstdDecompressor()
    if zstandard.frame_content_size(data) == size:
        return decompressor.decompress(data)
    with decompressor.stream_reader(data, read_across_frames=True) as stream:
        return stream.read(size + 1)


_PIECE_BYTES: Final = 1024 * 1024
_MESSAGE: Final = struct.Struct("<HIQQ")
_CRC: Final = struct.Struct("<I")
_MESSAGE_OPCODES: Final = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


class ForeignDamage(ValueError):
    """The file is damaged or over a limit from byte ``at`` on."""

    def __init__(self, text: str, at: int) -> None:
        super().__init__(text)
        self.at = at


class ForeignRecord(NamedTuple):
    """A record; ``at`` is the byte at which it, or the chunk around it, starts. Of a message that
    is too large ``content`` ends before the payload, of which ``excerpt`` is kept."""

    opcode: int
    content: bytes
    at: int
    excerpt: Excerpt | None = None


class ForeignMessage(NamedTuple):
    """One message, with an excerpt of a payload over `MAX_FOREIGN_BYTES`. ``key`` is its MCAP
    topic; times are int nanoseconds; ``schema`` is the name of its channel's schema, empty without
    one; ``version`` is the envelope version that a mapfold log has it in, None in other files;
    ``form`` is what its channel and schema say, ``verbatim`` the same for a verbatim message of a
    mapfold log."""

    key: str
    encoding: str
    schema: str
    version: int | None
    verbatim: MessageFormat | None
    form: MessageFormat
    logged_ns: int
    published_ns: int
    payload: bytes | Excerpt


class _ChannelName(NamedTuple):
    """The topic, message encoding and schema of a channel; if it has them, its envelope version
    and the format of its verbatim messages; the format of its messages."""

    key: str
    encoding: str
    schema: str
    version: int | None
    verbatim: MessageFormat | None
    form: MessageFormat


def foreign_messages(file: BinaryIO) -> Iterator[ForeignMessage]:
    """Every message; CRCs are checked, that of a chunk over `MAX_FOREIGN_BYTES` behind its
    messages. Raises ForeignDamage after the last good one."""
    source = _CrcReader(file)
    with _raising_foreign_damage(source):
        yield from _messages(_records(source, _MESSAGE_OPCODES, MAX_FOREIGN_BYTES))


@contextmanager
def _raising_foreign_damage(source: "_CrcReader") -> Iterator[None]:
    try:
        yield
    except BadRecord as error:
        at = source.record_at
        raise ForeignDamage(f"torn, damaged or over a limit, at byte {at:,}: {error}", at) from None


class _CrcReader:
    """Reads a file from front to back in pieces; ``crc`` covers everything read."""

    def __init__(self, file: "_Readable") -> None:
        self._file = file
        self._at = 0
        self.record_at = 0
        self.crc = 0

    def read(self, length: int) -> bytes:
        """Exactly ``length`` bytes. Memory grows with the bytes read, not with ``length``."""
        return b"".join(self.pieces(length))

    def skip(self, length: int) -> None:
        """Read ``length`` bytes and drop them."""
        for _ in self.pieces(length):
            pass

    def begin_record(self) -> None:
        """Note the current position as the start of a record, for error messages."""
        self.record_at = self._at

    def pieces(self, length: int) -> Iterator[bytes]:
        """``length`` bytes, piece by piece."""
        while length > 0:
            piece = self._file.read(min(length, _PIECE_BYTES))
            if not piece:
                raise BadRecord(f"the file ends {length:,} bytes too soon")
            self._at += len(piece)
            self.crc = crc32(piece, self.crc)
            length -= len(piece)
            yield piece


class _Readable(Protocol):
    def read(self, size: int = ..., /) -> bytes: ...


def _records(
    source: _CrcReader, opcodes: Collection[int], max_bytes: int
) -> Iterator[ForeignRecord]:
    _check_magic(source)
    while True:
        source.begin_record()
        crc = source.crc
        opcode, length = FRAME.unpack(source.read(FRAME.size))
        if opcode == 0:  # as in a hole of a sparse file, which may be gigabytes of such "records"
            raise BadRecord("zeros where a record should be")
        if opcode not in (Opcode.CHUNK, Opcode.DATA_END, *opcodes):
            source.skip(length)
            if opcode == Opcode.FOOTER:
                return _check_magic(source)
            continue
        if opcode == Opcode.MESSAGE and length > max_bytes + _MESSAGE.size:
            yield _large_message(source, length, source.record_at)
            continue
        if opcode == Opcode.CHUNK and length >= _HEAD.size:
            head = source.read(_HEAD.size)
            size = _HEAD.unpack(head)[2]
            if max(size, length) > max_bytes:
                yield from _large_chunk(source, head, length - len(head), opcodes, max_bytes)
                continue
            content = head + source.read(length - len(head))
        else:
            check_size("record", length, max_bytes + _MESSAGE.size)
            content = source.read(length)
        if opcode == Opcode.CHUNK:
            body = decode_foreign_chunk(content, max_bytes)
            del content
            for inner, data in _mcap.records(body):
                if inner in opcodes:
                    yield ForeignRecord(inner, data, source.record_at)
        elif opcode == Opcode.DATA_END:
            _check_data_crc(content, crc)
        else:
            yield ForeignRecord(opcode, content, source.record_at)


def _large_message(source: _CrcReader, length: int, at: int) -> ForeignRecord:
    """The record of a message of ``length`` bytes, of whose payload an excerpt is made."""
    head = source.read(_MESSAGE.size)
    return ForeignRecord(
        Opcode.MESSAGE, head, at, Excerpt.of(source.pieces(length - _MESSAGE.size))
    )


def _large_chunk(
    source: _CrcReader, head: bytes, length: int, opcodes: Collection[int], max_bytes: int
) -> Iterator[ForeignRecord]:
    """The records of a chunk over ``max_bytes``, read in pieces. ``head`` is its start, and
    ``length`` bytes of it are left."""
    _, _, size, crc, name_size = _HEAD.unpack(head)
    check_size("chunk", max(size, length), _MAX_STREAMED_BYTES)
    length -= name_size + _U64.size
    if length < 0:
        raise BadRecord("a chunk's head is cut short")
    name = source.read(name_size)
    (data_size,) = _U64.unpack(source.read(_U64.size))
    if data_size > length:
        raise BadRecord("a chunk's content is longer than the chunk")
    data = _Limited(source, data_size)
    with _raising_bad_record():
        body = _CrcReader(_decompressing(name, data))
        left = size
        while left > 0:
            opcode, inner_length = FRAME.unpack(body.read(FRAME.size))
            left -= FRAME.size + inner_length
            if left < 0 or opcode == 0:
                raise BadRecord("a chunk in which a record is cut short, or zeros for a record")
            if opcode not in opcodes:
                body.skip(inner_length)
            elif opcode == Opcode.MESSAGE and inner_length > max_bytes + _MESSAGE.size:
                yield _large_message(body, inner_length, source.record_at)
            else:
                check_size("record", inner_length, max_bytes + _MESSAGE.size)
                yield ForeignRecord(opcode, body.read(inner_length), source.record_at)
    if crc and body.crc != crc:
        raise BadRecord("a chunk does not match its CRC")
    source.skip(data.left + length - data_size)


class _Limited(io.RawIOBase):
    """The next ``left`` bytes of a source as a file."""

    def __init__(self, source: _CrcReader, left: int) -> None:
        super().__init__()
        self._source = source
        self.left = left

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1, /) -> bytes:
        size = min(self.left, _PIECE_BYTES if size < 0 else size)
        self.left -= size
        return self._source.read(size)


def _decompressing(name: bytes, data: _Limited) -> _Readable:
    match name:
        case b"":
            return data
        case b"zstd":
            file = cast(BinaryIO, data)
            return zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
        case b"lz4":
            return cast(_Readable, LZ4FrameFile(data))
    raise _unknown_compression(name)


def _check_magic(source: _CrcReader) -> None:
    if source.read(len(MAGIC)) != MAGIC:
        raise BadRecord("no MCAP magic")


def _check_data_crc(content: bytes, crc: int) -> None:
    if len(content) < _CRC.size or _CRC.unpack_from(content)[0] not in (0, crc):
        raise BadRecord("the data does not match its CRC")


def _messages(records: Iterator[ForeignRecord]) -> Iterator[ForeignMessage]:
    channels = _Channels()
    for opcode, content, _, excerpt in records:
        if opcode == Opcode.SCHEMA:
            channels.add_schema(content)
        elif opcode == Opcode.CHANNEL:
            channels.add(content)
        else:
            yield channels.message(content, excerpt)


class _Channels:
    def __init__(self) -> None:
        self._names: dict[int, _ChannelName] = {}
        self._schemas: dict[int, Schema] = {}
        self._size = self._text_size = 0

    def add_schema(self, content: bytes) -> None:
        schema = _mcap.decode_as(Schema, content)
        if self._schemas.get(schema.id) != schema:
            self._size += len(schema.name)
            _mcap.check_definitions(self._size)
            self._text_size += len(schema.data)
            if self._text_size > _mcap.MAX_DEFINITIONS_BYTES:  # in no segment of a log
                schema.data = b""
            self._schemas[schema.id] = schema

    def add(self, content: bytes) -> None:
        _mcap.check_definitions(len(content))
        channel = _mcap.decode_as(Channel, content)
        schema = self._schemas.get(channel.schema_id)
        form = message_format(channel, schema)
        name = _ChannelName(
            channel.topic,
            channel.message_encoding,
            "" if schema is None else schema.name,
            envelope_version(channel) if ENVELOPE_VERSION_KEY in channel.metadata else None,
            form if is_verbatim(channel) else None,
            form,
        )
        if self._names.get(channel.id) != name:
            self._size += len(name.key) + len(name.encoding) + len(name.schema)
            _mcap.check_definitions(self._size)
            self._names[channel.id] = name

    def message(self, content: bytes, excerpt: Excerpt | None) -> ForeignMessage:
        if len(content) < _MESSAGE.size:
            raise BadRecord("a message is cut short")
        id_, _, logged_ns, published_ns = _MESSAGE.unpack_from(content)
        if id_ not in self._names:
            raise BadRecord(f"a message of channel {id_}, which nothing defines")
        payload = content[_MESSAGE.size :] if excerpt is None else excerpt
        return ForeignMessage(*self._names[id_], logged_ns, published_ns, payload)
