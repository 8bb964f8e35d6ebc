"""Occupancy maps from nav_msgs/OccupancyGrid messages, as JSON or in CDR.

CDR is how bridges send the message and bags hold it. This one has a reader of its own, as rosbags
is an extra: its fields are fixed, and CDR's rules are three.

The JSON has the fields of the ROS message: ``info`` with ``resolution``, ``width``, ``height`` and
``origin`` (``position`` and the quaternion ``orientation``), and ``data``, row by row from the
origin: -1 for unknown, else 0 to 100. ``header`` is optional, and so is ``floor``, which ROS does
not have: the floor that the map shows, as in envelopes.
"""

import math
import re
from typing import Annotated, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from eventsrc.base.text import visible

from .cdr import CdrFault, CdrFields, is_cdr
from .occupancy_map import UNKNOWN, InvalidMap, OccupancyMap, check_size

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


_MARKS = (b'"info"', b'"resolution"', b'"data"')
_MOST_BYTES_A_CELL = 8
"""Bound of the JSON of one cell: ``-1`` or ``100``, a comma and white space."""
_MAX_TILT = 0.02
_UPRIGHT_ENOUGH = 1e-3


class _Position(msgspec.Struct):
    x: float = 0.0
    y: float = 0.0


class _Quaternion(msgspec.Struct):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


class _Origin(msgspec.Struct):
    position: _Position = msgspec.field(default_factory=_Position)
    orientation: _Quaternion = msgspec.field(default_factory=_Quaternion)


class _Info(msgspec.Struct):
    resolution: float
    width: Annotated[int, msgspec.Meta(ge=0, le=2**32 - 1)]
    height: Annotated[int, msgspec.Meta(ge=0, le=2**32 - 1)]
    origin: _Origin = msgspec.field(default_factory=_Origin)


class _Head(msgspec.Struct):
    """The message with its cells unparsed, so that its size is checked before they are decoded."""

    info: _Info
    data: msgspec.Raw
    floor: int | str | None = None


_HEAD = msgspec.json.Decoder(_Head)
_CELLS = msgspec.json.Decoder(list[Annotated[int, msgspec.Meta(ge=-1, le=100)]])


_NAMES_A_GRID = re.compile(r"(?:map|grid)(?:/|$)", re.IGNORECASE)
_TYPE_IN_KEY = re.compile(r"/(\w+)::\w+::dds_::(\w+)_(?:/|$)")
"""As rmw_zenoh has it: ``0/map/nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_…``."""
NO_GRID: Final = (
    "CDR, the encoding of ROS, under a key that does not name an occupancy grid: grids are read "
    "under keys such as tb/map, of which a part ends in map or grid; record other messages of ROS "
    "with --ros2dds"
)


def names_grid(key: str) -> bool:
    """Whether a key says that its messages in CDR, which do not say their type, are grids: by the
    type in it, else by a part that ends in ``map`` or ``grid``."""
    type_ = _TYPE_IN_KEY.search(key)
    if type_ is not None:
        return type_.groups() == ("nav_msgs", "OccupancyGrid")
    return _NAMES_A_GRID.search(key) is not None


def is_grid_message(payload: bytes) -> bool:
    """Whether a payload that is no envelope may be an occupancy grid: JSON with the fields of one,
    or CDR."""
    if is_cdr(payload):
        return True
    return payload.lstrip()[:1] == b"{" and all(mark in payload for mark in _MARKS)


def read_grid_message(payload: bytes, source: str) -> OccupancyMap:
    """The map of a message. ``source`` is the key or file that it came from. Raises InvalidMap."""
    return _read_cdr(payload, source) if is_cdr(payload) else _read_json(payload, source)


def _read_cdr(payload: bytes, source: str) -> OccupancyMap:
    read = decode_cdr_grid(payload)
    origin = (*read.position, _yaw(_Quaternion(*read.orientation)))
    grid = read.data.astype(np.uint8).reshape(read.height, read.width)  # -1 is 255
    return OccupancyMap(None, read.resolution, origin, source, grid)


def _read_json(payload: bytes, source: str) -> OccupancyMap:
    try:
        head = _HEAD.decode(payload)
    except (msgspec.DecodeError, RecursionError) as error:
        raise InvalidMap(f"no nav_msgs/OccupancyGrid: {visible(str(error))}") from None
    info = head.info
    check_size(info.width, info.height)
    count = info.width * info.height
    if len(head.data) > _MOST_BYTES_A_CELL * count + _MOST_BYTES_A_CELL:
        raise InvalidMap(f"data: more than the {count:,} values of {_size(info)} cells")
    try:
        values = _CELLS.decode(head.data)
    except msgspec.DecodeError as error:
        raise InvalidMap(f"data: {visible(str(error))}; -1 is unknown, else 0 to 100") from None
    if len(values) != count:
        raise InvalidMap(f"data: {len(values):,} values, where {_size(info)} cells take {count:,}")
    cells = np.array(values, np.int16)
    cells[cells < 0] = UNKNOWN
    at = info.origin.position
    origin = (at.x, at.y, _yaw(info.origin.orientation))
    grid = cells.astype(np.uint8).reshape(info.height, info.width)
    floor = None if head.floor is None else str(head.floor)
    return OccupancyMap(None, info.resolution, origin, source, grid, floor)


def _size(info: _Info) -> str:
    return f"{info.width:,} × {info.height:,}"


def _yaw(q: _Quaternion) -> float:
    """Radians about the vertical; 0 for a quaternion of zeros, the default of an unset field."""
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if norm == 0.0:
        return 0.0
    if abs(norm - 1.0) > _MAX_TILT or math.hypot(q.x, q.y) > _UPRIGHT_ENOUGH:
        raise InvalidMap(
            f"info.origin.orientation: ({q.x:g}, {q.y:g}, {q.z:g}, {q.w:g}) is no turn about the "
            "vertical"
        )
    return 2.0 * math.atan2(q.z, q.w)
