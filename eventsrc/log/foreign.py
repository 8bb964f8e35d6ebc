"""Messages of MCAP files that others wrote, in file order.

The mcap package takes as much memory as a file declares that it needs, and a file of 98 kB can
declare, and hold, gigabytes. So records are read here, against limits, and what is not a channel, a
chunk or a message is passed by in pieces.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final, NamedTuple

from . import _mcap
from ._foreign_chunk import check_size, foreign_body
from ._mcap import FRAME, MAGIC, BadRecord, Channel, Opcode

_PIECE: Final = 1024 * 1024
_MESSAGE: Final = struct.Struct("<HIQQ")
_CRC: Final = struct.Struct("<I")
_READ: Final = (Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END)


class ForeignDamage(ValueError):
    """The file is torn, rotten, or more than is read; says where."""


@dataclass(frozen=True, slots=True)
class ForeignMessage:
    """One message: MCAP's topic is the key, its log and publish time are int nanoseconds."""

    key: str
    encoding: str
    logged_ns: int
    published_ns: int
    payload: bytes


class _Named(NamedTuple):
    """What is kept of a channel."""

    key: str
    encoding: str


def foreign_messages(file: BinaryIO) -> Iterator[ForeignMessage]:
    """Every message, with CRCs checked. Raises ForeignDamage after the last good one."""
    source = _Source(file)
    try:
        yield from _Reading(source).messages()
    except BadRecord as error:
        raise ForeignDamage(
            f"torn or damaged, or more than is read, at byte {source.record_at:,}: {error}"
        ) from None


class _Source:
    """Reads front to back, a piece at a time; ``crc`` is that of everything read."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._at = 0
        self.record_at = 0
        self.crc = 0

    def read(self, length: int) -> bytes:
        """Exactly so many bytes. Memory is taken as they come, not as they are announced."""
        data = b"".join(self._pieces(length))
        self.crc = zlib.crc32(data, self.crc)
        return data

    def skip(self, length: int) -> None:
        """Pass by so many bytes."""
        for piece in self._pieces(length):
            self.crc = zlib.crc32(piece, self.crc)

    def begin_record(self) -> None:
        """Remember the place, for who tells of damage."""
        self.record_at = self._at

    def _pieces(self, length: int) -> Iterator[bytes]:
        while length > 0:
            piece = self._file.read(min(length, _PIECE))
            if not piece:
                raise BadRecord(f"the file ends {length:,} bytes too soon")
            self._at += len(piece)
            length -= len(piece)
            yield piece


class _Reading:
    def __init__(self, source: _Source) -> None:
        self._source = source
        self._channels: dict[int, _Named] = {}
        self._names_size = 0

    def messages(self) -> Iterator[ForeignMessage]:
        source = self._source
        self._check_magic()
        while True:
            source.begin_record()
            crc = source.crc
            opcode, length = FRAME.unpack(source.read(FRAME.size))
            if opcode not in _READ:
                source.skip(length)
                if opcode == Opcode.FOOTER:
                    return self._check_magic()
                continue
            check_size("record", length)
            content = source.read(length)
            if opcode == Opcode.CHUNK:
                body = foreign_body(content)
                del content
                yield from self._messages_in(body)
            elif opcode == Opcode.DATA_END:
                self._check_data(content, crc)
            else:
                yield from self._take(opcode, content)

    def _check_magic(self) -> None:
        if self._source.read(len(MAGIC)) != MAGIC:
            raise BadRecord("no MCAP magic")

    def _check_data(self, content: bytes, crc: int) -> None:
        if len(content) < _CRC.size or _CRC.unpack_from(content)[0] not in (0, crc):
            raise BadRecord("the data does not match its CRC")

    def _messages_in(self, body: bytes) -> Iterator[ForeignMessage]:
        for opcode, content in _mcap.records(body):
            if opcode in (Opcode.CHANNEL, Opcode.MESSAGE):
                yield from self._take(opcode, content)

    def _take(self, opcode: int, content: bytes) -> Iterator[ForeignMessage]:
        if opcode == Opcode.CHANNEL:
            self._take_channel(content)
        else:
            yield self._message(content)

    def _take_channel(self, content: bytes) -> None:
        _mcap.check_definitions(len(content))
        channel = _mcap.decode_as(Channel, content)
        named = _Named(channel.topic, channel.message_encoding)
        if self._channels.get(channel.id) != named:
            self._names_size += len(named.key) + len(named.encoding)
            _mcap.check_definitions(self._names_size)
            self._channels[channel.id] = named

    def _message(self, content: bytes) -> ForeignMessage:
        if len(content) < _MESSAGE.size:
            raise BadRecord("a message is cut short")
        id_, _, logged_ns, published_ns = _MESSAGE.unpack_from(content)
        if id_ not in self._channels:
            raise BadRecord(f"a message of channel {id_}, which nothing defines")
        payload = content[_MESSAGE.size :]
        return ForeignMessage(*self._channels[id_], logged_ns, published_ns, payload)
