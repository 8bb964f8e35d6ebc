"""Any bytes: messages, and whatever else comes."""

import json
import math
import struct

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.adapters.detector.picture import PictureError
from eventsrc.adapters.detector.picture_sources import picture_of
from eventsrc.adapters.detector.poses import MessageError, pose_of
from eventsrc.adapters.detector.vision import encode_jpeg
from tests.support.drawn_pictures import compressed_image

_PIXELS = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
JPEG = encode_jpeg(_PIXELS)
MESSAGE = compressed_image(5.0, JPEG)


@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_are_a_pose_or_no_pose(data: bytes, cdr: bool) -> None:
    try:
        stamp_s, pose = pose_of((b"\0\1\0\0" if cdr else b"") + data, 9.0)
    except MessageError:
        return
    assert stamp_s >= 0.0
    assert all(map(math.isfinite, pose))


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=4),
        lambda inner: st.dictionaries(
            st.sampled_from(["x", "y", "yaw", "stamp", "map_x", "timestamp"]), inner
        ),
        max_leaves=8,
    )
)
def test_any_json_is_a_pose_or_no_pose(document: object) -> None:
    try:
        stamp_s, pose = pose_of(json.dumps(document).encode(), 9.0)
    except MessageError:
        return
    assert stamp_s >= 0.0
    assert all(map(math.isfinite, pose))


@given(st.integers(4, len(MESSAGE) - 1), st.binary(min_size=1, max_size=4))
def test_a_message_with_other_bytes_is_a_picture_or_none(at: int, bytes_: bytes) -> None:
    damaged = MESSAGE[:at] + bytes_ + MESSAGE[at + len(bytes_) :]
    try:
        picture = picture_of(damaged, "p", 9.0)
        assert picture.stamp_s >= 0.0
        assert picture.pixels().ndim == 3
    except (MessageError, PictureError):
        pass


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_a_raw_picture_says_no_more_than_it_has(height: int, width: int, step: int) -> None:
    body = struct.pack("<iII", 1, 0, 1) + b"\0\0\0\0" + struct.pack("<III", height, width, 5)
    body += b"bgr8\0" + b"\0" + b"\0\0" + struct.pack("<II", step, 96) + bytes(96)
    try:
        pixels = picture_of(b"\0\1\0\0" + body, "p", 9.0).pixels()
        assert pixels.shape == (height, width, 3)
        assert pixels.size <= 96
    except (MessageError, PictureError):
        pass
