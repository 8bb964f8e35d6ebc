"""CDR, the encoding of ROS 2 messages: a reader of fields, from front to back.

The first four bytes are the encapsulation: ``00 00`` for big endian, ``00 01`` for little endian,
and two bytes of options. After them come the fields in the order of the message's definition, each
number at a multiple of its size, counted from the end of the encapsulation; a text or a sequence is
its length and its items. Every declared length is compared with the bytes left before it is used.
"""

import struct
from typing import Any, Final

_BYTE_ORDERS: Final = {b"\0\0": ">", b"\0\1": "<"}
_HEAD_BYTES: Final = 4
_MOST_PADDING: Final = 3
"""Bytes that may follow the last field."""


class CdrFault(ValueError):
    """A payload does not fit the message type that it is read as; the text names the field."""


def is_cdr(payload: bytes) -> bool:
    """Whether a payload begins with the encapsulation of CDR. JSON never does."""
    return payload[:2] in _BYTE_ORDERS


class CdrFields:
    """Reads the fields of a payload that `is_cdr`, in order. ``field`` is its name in errors.

    Every method but `left` raises CdrFault if the payload ends too soon.
    """

    def __init__(self, payload: bytes) -> None:
        self._order = _BYTE_ORDERS[payload[:2]]
        self._body = memoryview(payload)[_HEAD_BYTES:]
        self._at = 0

    def numbers(self, kinds: str, field: str) -> tuple[Any, ...]:
        """The next numbers, aligned to their size. ``kinds`` are letters of `struct`, all of one
        size."""
        size = struct.calcsize(f"={kinds[0]}")
        start = -(-self._at // size) * size
        layout = struct.Struct(self._order + kinds)
        self._need(start + layout.size, field)
        self._at = start + layout.size
        return layout.unpack_from(self._body, start)

    def text(self, field: str) -> bytes:
        """The next text, without its closing null character, which its length includes."""
        (length,) = self.numbers("I", f"the length of {field}")
        self._need(self._at + length, field)
        self._at += length
        if length and self._body[self._at - 1]:
            raise CdrFault(f"{field} does not end in a null character")
        return bytes(self._body[self._at - length : self._at - 1]) if length else b""

    def last(self, length: int, field: str) -> memoryview:
        """The ``length`` bytes of the last field. Raises CdrFault if more than padding follows."""
        self._need(self._at + length, field)
        rest = len(self._body) - self._at - length
        if rest > _MOST_PADDING:
            raise CdrFault(f"{rest:,} bytes follow its last field")
        return self._body[self._at : self._at + length]

    def left(self, size: int) -> int:
        """Number of bytes left after aligning to numbers of ``size`` bytes."""
        return len(self._body) - -(-self._at // size) * size

    def _need(self, end: int, field: str) -> None:
        if end > len(self._body):
            there = len(self._body) + _HEAD_BYTES
            raise CdrFault(f"{field} would end at byte {end + _HEAD_BYTES:,} of {there:,}")
