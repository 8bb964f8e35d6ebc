"""nav_msgs/OccupancyGrid in CDR, the encoding of ROS 2, as a bridge sends it or a bag holds it.

A reader of this one message only; docs/decisions/map-messages.md says why. The first four bytes are
the encapsulation: ``00 00`` for big endian, ``00 01`` for little endian, and two bytes of options.
After them come the fields in the order of the message's definition, each number at a multiple of
its size, counted from the end of the encapsulation; a text or a sequence is its length and its
items. Whatever a message declares is compared with the bytes that are there before it is read.
"""

import struct
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .occupancy_map import InvalidMap, check_size

GRID_SCHEMA: Final = "nav_msgs/msg/OccupancyGrid"
"""Its name in an MCAP file."""
_BYTE_ORDERS: Final = {b"\0\0": ">", b"\0\1": "<"}
_HEAD_BYTES: Final = 4
_MOST_PADDING: Final = 3
"""Bytes that may follow the last field."""


class CdrGrid(NamedTuple):
    """The fields that a map is made of; ``data`` has -1 for unknown, row by row from the origin."""

    resolution: float
    width: int
    height: int
    position: tuple[float, float]
    orientation: tuple[float, float, float, float]
    data: NDArray[np.int8]


def is_cdr(payload: bytes) -> bool:
    """Whether a payload begins as CDR does, which JSON never does."""
    return payload[:2] in _BYTE_ORDERS


def decode_cdr_grid(payload: bytes) -> CdrGrid:
    """The grid of a payload that `is_cdr`. Raises InvalidMap, with the field."""
    fields = _Fields(payload)
    fields.numbers("iI", "header.stamp")
    fields.text("header.frame_id")
    fields.numbers("iI", "info.map_load_time")
    (resolution,) = fields.numbers("f", "info.resolution")
    width, height = fields.numbers("II", "info.width and info.height")
    x, y, _ = fields.numbers("ddd", "info.origin.position")
    qx, qy, qz, qw = fields.numbers("dddd", "info.origin.orientation")
    check_size(width, height)
    (count,) = fields.numbers("I", "the length of data")
    if count != width * height:
        raise InvalidMap(
            f"data: {count:,} values, where {width:,} × {height:,} cells take {width * height:,}"
        )
    data = np.frombuffer(fields.last(count), np.int8)
    wrong = np.flatnonzero((data < -1) | (data > 100))
    if len(wrong):
        raise InvalidMap(
            f"data: value {data[wrong[0]]} at index {wrong[0]:,}; -1 is unknown, else 0 to 100"
        )
    # The shortest decimal that names the float32: 0.05, as the map server was told.
    shortest = float(str(np.float32(resolution)))
    return CdrGrid(shortest, width, height, (x, y), (qx, qy, qz, qw), data)


class _Fields:
    """Reads a payload from front to back."""

    def __init__(self, payload: bytes) -> None:
        self._order = _BYTE_ORDERS[payload[:2]]
        self._body = memoryview(payload)[_HEAD_BYTES:]
        self._at = 0

    def numbers(self, kinds: str, field: str) -> tuple[Any, ...]:
        """Numbers of one size, by the letters of `struct`."""
        size = struct.calcsize(f"={kinds[0]}")
        start = -(-self._at // size) * size
        layout = struct.Struct(self._order + kinds)
        self._need(start + layout.size, field)
        self._at = start + layout.size
        return layout.unpack_from(self._body, start)

    def text(self, field: str) -> None:
        """Pass over a text, which ends in a null character that its length counts."""
        (length,) = self.numbers("I", f"the length of {field}")
        self._need(self._at + length, field)
        self._at += length
        if length and self._body[self._at - 1]:
            raise InvalidMap(f"{_NOT_ONE}: {field} does not end in a null character")

    def last(self, length: int) -> memoryview:
        """The bytes of the last field."""
        self._need(self._at + length, "data")
        rest = len(self._body) - self._at - length
        if rest > _MOST_PADDING:
            raise InvalidMap(f"{_NOT_ONE}: {rest:,} bytes follow its last field")
        return self._body[self._at : self._at + length]

    def _need(self, end: int, field: str) -> None:
        if end > len(self._body):
            there = len(self._body) + _HEAD_BYTES
            raise InvalidMap(
                f"{_NOT_ONE}: {field} would end at byte {end + _HEAD_BYTES:,} of {there:,}"
            )


_NOT_ONE: Final = "neither JSON nor nav_msgs/OccupancyGrid in CDR"
