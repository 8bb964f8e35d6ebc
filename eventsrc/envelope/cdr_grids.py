"""Decode nav_msgs/OccupancyGrid in CDR, the encoding of ROS 2, as bridges send it and bags hold it.

docs/decisions/map-messages.md says why this one message has a reader of its own.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .cdr import CdrFault, CdrFields, is_cdr
from .occupancy_map import InvalidMap, check_size

__all__ = ["GRID_SCHEMA", "CdrGrid", "decode_cdr_grid", "is_cdr"]

GRID_SCHEMA: Final = "nav_msgs/msg/OccupancyGrid"
"""The name of its schema in an MCAP file."""


class CdrGrid(NamedTuple):
    """The fields that a map is made of. ``resolution`` is in metres; ``data`` is row by row from
    the origin: -1 for unknown, else 0 to 100."""

    resolution: float
    width: int
    height: int
    position: tuple[float, float]
    orientation: tuple[float, float, float, float]
    data: NDArray[np.int8]


def decode_cdr_grid(payload: bytes) -> CdrGrid:
    """The grid of a payload that `is_cdr`. Raises InvalidMap, which names the field."""
    try:
        return _decode(CdrFields(payload))
    except CdrFault as fault:
        raise InvalidMap(f"{_NOT_ONE}: {fault}") from None


def _decode(fields: CdrFields) -> CdrGrid:
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
    data = np.frombuffer(fields.last(count, "data"), np.int8)
    wrong = np.flatnonzero((data < -1) | (data > 100))
    if len(wrong):
        raise InvalidMap(
            f"data: value {data[wrong[0]]} at index {wrong[0]:,}; -1 is unknown, else 0 to 100"
        )
    # The shortest decimal that names the float32, such as the 0.05 of a map server's settings.
    shortest = float(str(np.float32(resolution)))
    return CdrGrid(shortest, width, height, (x, y), (qx, qy, qz, qw), data)


_NOT_ONE: Final = "neither JSON nor nav_msgs/OccupancyGrid in CDR"
