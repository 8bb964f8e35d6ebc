"""Find the size and the end of a JPEG or PNG without decoding it.

So a picture that is cut short, or huge by its header, is refused before any pixel is decoded.
"""

import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

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


def check_picture(data: bytes) -> None:
    """Raise PictureError unless ``data`` is a whole JPEG or PNG within the limits."""
    if not data:
        raise PictureError("it is empty")
    if len(data) > MAX_PICTURE_BYTES:
        raise PictureError(f"it has {len(data):,} bytes, more than {MAX_PICTURE_BYTES:,}")
    width, height = _size(data)
    if width * height > MAX_PICTURE_PIXELS:
        raise PictureError(
            f"it has {width:,} × {height:,} pixels, more than {MAX_PICTURE_PIXELS:,}"
        )


def _size(data: bytes) -> tuple[int, int]:
    """Width and height of a picture that has its end."""
    if data.startswith(JPEG_START[: len(data)]):
        width, height = _jpeg_size(data)
    elif data.startswith(PNG_START[: len(data)]):
        width, height = _png_size(data)
    else:
        raise PictureError(f"it is neither JPEG nor PNG: it begins with {data[:4].hex(' ')}")
    if not width or not height:
        raise PictureError("its head gives no size")
    return width, height


def _jpeg_size(data: bytes) -> tuple[int, int]:
    width = height = 0
    at = 2
    while True:
        marker = _NEXT_MARKER.search(data, at)
        if marker is None:
            raise PictureError(f"this JPEG is cut short: {len(data):,} bytes without its end")
        code, at = marker[1][0], marker.end()
        if code == _END:
            return width, height
        if code in _NO_LENGTH:
            continue
        if at + 2 > len(data):
            raise PictureError("this JPEG is cut short within its head")
        (length,) = struct.unpack_from(">H", data, at)
        if code in _FRAMES and length >= 7 and at + 7 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 3)
        at += length  # behind a scan's head come its pixels, in which no marker stands


def _png_size(data: bytes) -> tuple[int, int]:
    width = height = 0
    at = len(PNG_START)
    while True:
        if at + 12 > len(data):
            raise PictureError(f"this PNG is cut short: {len(data):,} bytes without its end")
        length, kind = struct.unpack_from(">I4s", data, at)
        if length > MAX_PICTURE_BYTES:
            raise PictureError(f"this PNG is damaged: a chunk of {length:,} bytes")
        end = at + 12 + length
        if end > len(data):
            raise PictureError(f"this PNG is cut short: {len(data):,} bytes without its end")
        (stated,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != stated:
            raise PictureError("this PNG is damaged: the CRC of a chunk does not match")
        if kind == b"IHDR" and length >= 8:
            width, height = struct.unpack_from(">II", data, at + 8)
        at = end
        if kind == b"IEND":
            return width, height
