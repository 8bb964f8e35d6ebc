"""The content of a chunk that another program compressed, checked against limits before memory is
taken: what a chunk declares of itself may be anything, and so may what its compression declares."""

import struct
import zlib
from typing import Final

import zstandard
from lz4.frame import LZ4FrameDecompressor

from ._mcap import BadRecord

MAX_FOREIGN_BYTES: Final = 64 * 1024 * 1024
"""Of a chunk, compressed or not, and of a message. One of that size that is no envelope can still
be kept in a log."""
_HEAD = struct.Struct("<QQQII")
"""First and last log time, uncompressed size and its CRC, length of the compression's name."""
_U64 = struct.Struct("<Q")


def check_size(what: str, size: int, most: int) -> None:
    """BadRecord when a ``what`` declares a ``size`` that is over the limit."""
    if size > most:
        raise BadRecord(
            f"a {what} declares {size:,} bytes, more than {most:,} are read; if that "
            "is right, write the file again in smaller chunks (`mcap compress --chunk-size`)"
        )


def foreign_body(content: bytes, most: int) -> bytes:
    """The records in the chunk whose record has this content, ``most`` bytes of them at most.
    Raises BadRecord."""
    try:
        _, _, size, crc, name_size = _HEAD.unpack_from(content)
        data_at = _HEAD.size + name_size + _U64.size
        (data_size,) = _U64.unpack_from(content, _HEAD.size + name_size)
    except struct.error:
        raise BadRecord("a chunk's head is cut short") from None
    name = content[_HEAD.size : _HEAD.size + name_size]
    check_size("chunk", size, most)
    if data_at + data_size > len(content):
        raise BadRecord("a chunk's content is longer than the chunk")
    body = _plain(name, content[data_at : data_at + data_size], size)
    if len(body) != size:
        than = "more" if len(body) > size else "less"
        raise BadRecord(f"a chunk holds {than} than the {size:,} bytes that it declares")
    if crc and zlib.crc32(body) != crc:
        raise BadRecord("a chunk does not match its CRC")
    return body


def _plain(name: bytes, data: bytes, size: int) -> bytes:
    """At most one byte more than ``size``."""
    try:
        match name:
            case b"":
                return data[: size + 1]
            case b"zstd":
                return _zstd(data, size)
            case b"lz4":
                return bytes(LZ4FrameDecompressor().decompress(data, size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise BadRecord(f"a chunk cannot be decompressed: {error}") from None
    raise BadRecord(f"a chunk is compressed with {name[:32]!r}; zstd and lz4 are read")


def _zstd(data: bytes, size: int) -> bytes:
    decompressor = zstandard.ZstdDecompressor()
    if zstandard.frame_content_size(data) == size:
        return decompressor.decompress(data)
    with decompressor.stream_reader(data, read_across_frames=True) as stream:
        return stream.read(size + 1)
