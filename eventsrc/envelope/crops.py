"""Crops of detections: JPEGs of the pixels inside a detection's box, as verbatim messages of a log.

A detector publishes them under ``PREFIX/DET_ID``, the det_id percent-encoded. In a log all are on
the topic ``PREFIX``, as sensor_msgs/CompressedImage in CDR with the det_id as ``frame_id``, so that
Foxglove and Rerun show them. The JPEG itself is unchanged.
"""

import struct
from typing import Final, NamedTuple
from urllib.parse import unquote

from eventsrc.base.text import visible

from .cdr import CdrFault, CdrFields
from .model import MAX_ID_LENGTH, DetId

CROPS_TOPIC: Final = "tb/crops"
"""The topic of crops, unless another is chosen."""
CROP_SCHEMA: Final = "sensor_msgs/msg/CompressedImage"
CROP_ENCODING: Final = "cdr"
CROP_SCHEMA_ENCODING: Final = "ros2msg"
CROP_SCHEMA_TEXT: Final = b"""\
std_msgs/Header header
string format
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
MAX_CROP_BYTES: Final = 1024 * 1024
"""Bound of a crop's JPEG."""
_HEAD: Final = b"\0\1\0\0"
_JPEG_START: Final = b"\xff\xd8\xff"
_JPEG_END: Final = b"\xff\xd9"
_FORMAT: Final = b"jpeg"
_NS: Final = 1_000_000_000


class InvalidCrop(ValueError):
    """Bytes or a key that are no crop; the message says why."""


class Crop(NamedTuple):
    """The JPEG of a detection."""

    det_id: DetId
    jpeg: bytes


def received_crop(key: str, payload: bytes) -> tuple[str, Crop]:
    """Topic and crop of a message under ``PREFIX/DET_ID``. Raises InvalidCrop."""
    topic, slash, last = key.rpartition("/")
    try:
        det_id = unquote(last, errors="strict")
    except UnicodeDecodeError:
        raise InvalidCrop(f"{visible(last)}: the det_id in the key is no UTF-8") from None
    if not slash or not topic:
        raise InvalidCrop(f"{visible(key)}: a crop's key is PREFIX/DET_ID")
    return topic, _checked(det_id, payload)


def _checked(det_id: str, jpeg: bytes) -> Crop:
    if not 0 < len(det_id) <= MAX_ID_LENGTH or "\0" in det_id:
        raise InvalidCrop(f"{visible(det_id)[:80]!r} is no det_id")
    if len(jpeg) > MAX_CROP_BYTES:
        raise InvalidCrop(f"a crop of {len(jpeg):,} bytes; at most {MAX_CROP_BYTES:,}")
    if not jpeg.startswith(_JPEG_START) or _JPEG_END not in jpeg[-64:]:
        raise InvalidCrop(f"a crop that is no whole JPEG: it begins with {jpeg[:4].hex(' ')}")
    return Crop(DetId(det_id), jpeg)


def encode_crop(crop: Crop, stamp_ns: int) -> bytes:
    """The CompressedImage of a crop, in CDR."""
    frame_id = crop.det_id.encode() + b"\0"
    head = struct.pack("<iII", min(stamp_ns // _NS, 2**31 - 1), stamp_ns % _NS, len(frame_id))
    body = _padded(_padded(head + frame_id) + struct.pack("<I", len(_FORMAT) + 1) + _FORMAT + b"\0")
    return b"".join((_HEAD, body, struct.pack("<I", len(crop.jpeg)), crop.jpeg))


def _padded(body: bytes) -> bytes:
    return body + b"\0" * (-len(body) % 4)


def decode_crop(payload: bytes) -> Crop:
    """The crop that `encode_crop` made; others may write to the topic, too. Raises InvalidCrop."""
    if payload[: len(_HEAD)] != _HEAD:
        raise InvalidCrop("it is no message in CDR of little endian")
    fields = CdrFields(payload)
    try:
        fields.numbers("iI", "header.stamp")
        det_id = fields.text("header.frame_id").decode()
        fields.text("format")
        (length,) = fields.numbers("I", "the length of data")
        jpeg = bytes(fields.last(length, "data"))
    except (CdrFault, UnicodeDecodeError) as error:
        raise InvalidCrop(f"it is no sensor_msgs/CompressedImage: {error}") from None
    return _checked(det_id, jpeg)
