"""Find the size and the end of a JPEG or PNG without decoding it.

So a picture that is cut short, or huge by its header, is refused before any pixel is decoded, and a
stream of pictures, as ``ffmpeg -f image2pipe`` writes it, is split into its parts.
"""

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
"""Rows of blue, green and red, shape (height, width, 3)."""

MAX_PICTURE_BYTES: Final = 64 * 1024 * 1024
MAX_PICTURE_PIXELS: Final = 64_000_000
"""Bound of width times height: 8K has 33 million."""

JPEG_START: Final = b"\xff\xd8\xff"
PNG_START: Final = b"\x89PNG\r\n\x1a\n"
_NO_LENGTH: Final = frozenset({0x01, *range(0xD0, 0xD8)})
_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_END: Final = 0xD9
_NEXT_MARKER: Final = re.compile(rb"\xff+([^\x00\xff\xd0-\xd7])")
_ENDS: Final = (b"\xff\xd9", b"IEND\xaeB`\x82")
"""The last bytes of a JPEG and of a PNG."""
_READ_BYTES: Final = 64 * 1024


class PictureError(ValueError):
    """Bytes that are no usable picture; the message is the reason."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture from a source. ``pixels`` decodes it and raises PictureError.

    ``stamp_s`` is when it was taken, in seconds. ``pixels`` may be called until the source yields
    the next picture.
    """

    name: str
    stamp_s: float
    pixels: Callable[[], Pixels]


class _Extent(NamedTuple):
    width: int
    height: int
    end: int
    """The index behind the picture's last byte."""


class _CutShort(PictureError):
    """The bytes end before the picture does."""


def check_picture(data: bytes) -> None:
    """Raise PictureError unless ``data`` is a whole JPEG or PNG within the limits."""
    if not data:
        raise PictureError("it is empty")
    if len(data) > MAX_PICTURE_BYTES:
        raise PictureError(f"it has {len(data):,} bytes, more than {MAX_PICTURE_BYTES:,}")
    extent = _extent(data)
    if extent.width * extent.height > MAX_PICTURE_PIXELS:
        raise PictureError(
            f"it has {extent.width:,} × {extent.height:,} pixels, more than {MAX_PICTURE_PIXELS:,}"
        )


def split_stream(read: Callable[[int], bytes]) -> Iterator[bytes | PictureError]:
    """Split a stream of consecutive JPEG and PNG pictures.

    ``read`` returns up to so many bytes, none at the end. Each stretch of bytes that are no picture
    is yielded as one PictureError.
    """
    buffer = bytearray()
    ended = skipping = False
    while True:
        if not buffer:
            ended = ended or not _grow(buffer, read)
            if ended:
                return
        try:
            extent = _extent(buffer)
        except _CutShort as fault:
            if not ended and len(buffer) <= MAX_PICTURE_BYTES:
                ended = not _read_to_an_end(buffer, read)
                continue
            reason = str(fault)
        except PictureError as fault:
            reason = str(fault)
        else:
            yield bytes(buffer[: extent.end])
            del buffer[: extent.end]
            skipping = False
            continue
        if not skipping:
            yield PictureError(reason)
        skipping = True
        ended = not _skip_to_a_start(buffer, read, ended=ended)


def _skip_to_a_start(buffer: bytearray, read: Callable[[int], bytes], *, ended: bool) -> bool:
    """Drop the bytes before the next picture; False at the end of the stream."""
    del buffer[:1]
    while True:
        found = [buffer.find(mark) for mark in (JPEG_START, PNG_START)]
        there = [at for at in found if at >= 0]
        if there:
            del buffer[: min(there)]
            return not ended
        if ended:
            buffer.clear()
            return False
        del buffer[: 1 - len(PNG_START)]  # what remains may be the beginning of a mark
        ended = not _grow(buffer, read)


def _grow(buffer: bytearray, read: Callable[[int], bytes]) -> int:
    piece = read(_READ_BYTES)
    buffer += piece
    return len(piece)


def _read_to_an_end(buffer: bytearray, read: Callable[[int], bytes]) -> bool:
    """Read until the buffer has an end mark, so that a large picture is not parsed again after each
    read; False at the end of the stream."""
    while True:
        before = max(0, len(buffer) - max(map(len, _ENDS)))
        if not _grow(buffer, read):
            return False
        if len(buffer) > MAX_PICTURE_BYTES or any(buffer.find(e, before) >= 0 for e in _ENDS):
            return True


def _extent(data: bytes | bytearray) -> _Extent:
    if data.startswith(JPEG_START[: len(data)]):
        extent = _jpeg_extent(data)
    elif data.startswith(PNG_START[: len(data)]):
        extent = _png_extent(data)
    else:
        raise PictureError(f"it is neither JPEG nor PNG: it begins with {data[:4].hex(' ')}")
    if not extent.width or not extent.height:
        raise PictureError("its head gives no size")
    return extent


def _jpeg_extent(data: bytes | bytearray) -> _Extent:
    width = height = 0
    at = 2
    while True:
        marker = _NEXT_MARKER.search(data, at)
        if marker is None:
            raise _CutShort(f"this JPEG is cut short: {len(data):,} bytes without its end")
        code, at = marker[1][0], marker.end()
        if code == _END:
            return _Extent(width, height, at)
        if code in _NO_LENGTH:
            continue
        if at + 2 > len(data):
            raise _CutShort("this JPEG is cut short within its head")
        (length,) = struct.unpack_from(">H", data, at)
        if code in _FRAMES and length >= 7 and at + 7 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 3)
        at += length  # behind a scan's head come its pixels, in which no marker stands


def _png_extent(data: bytes | bytearray) -> _Extent:
    width = height = 0
    at = len(PNG_START)
    while True:
        if at + 12 > len(data):
            raise _CutShort(f"this PNG is cut short: {len(data):,} bytes without its end")
        length, kind = struct.unpack_from(">I4s", data, at)
        if length > MAX_PICTURE_BYTES:
            raise PictureError(f"this PNG is damaged: a chunk of {length:,} bytes")
        end = at + 12 + length
        if end > len(data):
            raise _CutShort(f"this PNG is cut short: {len(data):,} bytes without its end")
        (stated,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != stated:
            raise PictureError("this PNG is damaged: the CRC of a chunk does not match")
        if kind == b"IHDR" and length >= 8:
            width, height = struct.unpack_from(">II", data, at + 8)
        at = end
        if kind == b"IEND":
            return _Extent(width, height, at)
