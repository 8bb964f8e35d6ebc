"""Any bytes: streams of pictures however they are cut up, messages, and whatever else comes."""

import io
import json
import math
import struct

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.adapters.detector.picture import PictureError, check_picture, split_stream
from eventsrc.adapters.detector.picture_sources import picture_of
from eventsrc.adapters.detector.poses import MessageError, pose_of
from eventsrc.adapters.detector.vision import encode_jpeg
from eventsrc.envelope.grey_images import encode_png
from tests.support.drawn_pictures import compressed_image

_PIXELS = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
JPEG, PNG = encode_jpeg(_PIXELS), encode_png(_PIXELS[:, :, 0])
MESSAGE = compressed_image(5.0, JPEG)

PIECES = st.lists(
    st.sampled_from([JPEG, PNG])
    | st.binary(max_size=12)
    | st.tuples(st.sampled_from([JPEG, PNG]), st.integers(0, 400)).map(lambda p: p[0][: p[1]]),
    max_size=8,
)


def _split(data: bytes, sizes: list[int]) -> list[bytes | None]:
    """The pictures, None for what is none."""
    stream, steps = io.BytesIO(data), iter(sizes * (len(data) + 2))
    parts = split_stream(lambda size: stream.read(min(size, next(steps))))
    return [part if isinstance(part, bytes) else None for part in parts]


@given(PIECES, st.lists(st.integers(1, 300), min_size=1, max_size=5))
def test_a_stream_is_split_the_same_however_it_arrives(
    pieces: list[bytes], sizes: list[int]
) -> None:
    data = b"".join(pieces)
    parts = _split(data, [1 << 20])
    assert _split(data, sizes) == parts
    assert all(part in (JPEG, PNG, None) or part in data for part in parts if part is not None)
    for part in parts:
        if part is not None:
            check_picture(part)


def test_a_picture_behind_bytes_that_look_like_a_head_without_size_comes_out() -> None:
    assert _split(b"\xff\xd8\xff\x02\x00" + JPEG, [1 << 20]) == [None, JPEG]


@given(st.lists(st.sampled_from([JPEG, PNG]), max_size=6), st.integers(1, 500))
def test_whole_pictures_come_out_whole(pieces: list[bytes], size: int) -> None:
    assert _split(b"".join(pieces), [size]) == pieces


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
