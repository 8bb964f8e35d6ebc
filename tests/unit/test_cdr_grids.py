"""nav_msgs/OccupancyGrid in CDR: bytes that rosbags made, an encoder written from the format's
rules, and what is cut short, changed or hostile."""

import base64
import contextlib
import math
import struct
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.envelope.grid_messages import is_grid_message, names_grid, read_grid_message
from eventsrc.envelope.ingest import Rejected
from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import InvalidMap, OccupancyMap, decode_map
from eventsrc.record.append import NewMap, check_payloads
from tests.support.envelopes import payload
from tests.support.maps import cdr_message, drawn_map, grid_message
from tests.support.thorough import examples, rounds

# Made by rosbags 0.11.9, `serialize_cdr` of ROS 2 Humble's types: 3 × 2 cells of 0.05 m from
# (1.5, -2.25) turned by -0.7 rad, in the frame "map"; one cell of 0.1 m in a frame without name; a
# std_msgs/String and a sensor_msgs/LaserScan.
LITTLE = base64.b64decode(
    "AAEAAADxU2UVzVsHBAAAAG1hcAAFAAAABgAAAM3MTD0DAAAAAgAAAAAAAAAAAAAAAAD4PwAAAAAAAALAAAAAAAAAAAAAAAAAAAAA"
    "AAAAAAAAAAAAiwo5pQny1b+35Q1dVw/uPwYAAABk/wBBQAE="
)
BIG = base64.b64decode(
    "AAAAAGVT8QAHW80VAAAABG1hcAAAAAAFAAAABj1MzM0AAAADAAAAAgAAAAA/+AAAAAAAAMACAAAAAAAAAAAAAAAAAAAAAAAAAAAA"
    "AAAAAAAAAAAAv9XyCaU5Cos/7g9XXQ3ltwAAAAZk/wBBQAE="
)
ONE = base64.b64decode(
    "AAEAAADxU2UVzVsHAQAAAAAAAAAFAAAABgAAAM3MzD0BAAAAAQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA"
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAADwPwEAAAAA"
)
TEXT = base64.b64decode("AAEAABwAAABoZWxsbyB0aGVyZSwgdGhpcyBpcyBubyBtYXAA")
SCAN = base64.b64decode(
    "AAEAAADxU2UVzVsHBAAAAG1hcAAAAAAAAACAP83MzD0AAAAAzczMPc3MzD0AABBBFAAAAAAAgD8AAIA/AACAPwAAgD8AAIA/AACA"
    "PwAAgD8AAIA/AACAPwAAgD8AAIA/AACAPwAAgD8AAIA/AACAPwAAgD8AAIA/AACAPwAAgD8AAIA/FAAAAAAAgD8AAIA/AACAPwAA"
    "gD8AAIA/AACAPwAAgD8AAIA/AACAPwAAgD8AAIA/AACAPwAAgD8AAIA/AACAPwAAgD8AAIA/AACAPwAAgD8AAIA/"
)
MAP = drawn_map("#.? .##", 0.25, (1.5, -2.0, -0.7))


def _refused(message: bytes) -> str:
    with pytest.raises(InvalidMap) as caught:
        read_grid_message(message, "tb/map").encode()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("message", [LITTLE, BIG])
def test_a_message_of_another_program_is_read(message: bytes) -> None:
    assert is_grid_message(message)
    read = read_grid_message(message, "tb/map")
    assert read.cells.tolist() == [[100, 255, 0], [65, 64, 1]]
    assert (read.map_id, read.floor, read.source) == (None, None, "tb/map")
    assert read.resolution == 0.05, "what the float32 is short for"
    assert read.origin[:2] == (1.5, -2.25)
    assert math.isclose(read.origin[2], -0.7)
    read.encode()


def test_a_frame_without_a_name_is_read() -> None:
    assert read_grid_message(ONE, "k").cells.tolist() == [[0]]
    assert read_grid_message(ONE, "k").resolution == 0.1


def test_the_encoder_of_the_tests_makes_the_bytes_of_rosbags() -> None:
    made = read_grid_message(LITTLE, "k")
    for big, message in ((False, LITTLE), (True, BIG)):
        again = cdr_message(made, big=big, stamp=(1700000000, 123456789), loaded=(5, 6))
        assert again[:72] == message[:72]
        assert again[88:] != b""
        assert len(again) == len(message)
        assert read_grid_message(again, "k").digest() == made.digest()


@settings(max_examples=rounds(100, 5), deadline=None)
@given(
    st.integers(1, 20),
    st.integers(1, 20),
    st.text(max_size=12),
    st.booleans(),
    st.sampled_from([0.05, 0.1, 0.025, 1.0, 0.0123]),
    st.integers(0, 3),
    st.integers(0, 2**32 - 1),
)
def test_cdr_and_json_give_one_map(
    width: int, height: int, frame: str, big: bool, resolution: float, padding: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.choice(np.array([0, 7, 64, 65, 100, 255], np.uint8), (height, width))
    origin = (*rng.uniform(-50, 50, 2).tolist(), float(rng.uniform(-3, 3)))
    made = OccupancyMap(None, resolution, origin, "k", cells)
    in_cdr = cdr_message(made, big=big, frame=frame) + b"\0" * padding
    read = read_grid_message(in_cdr, "k")
    assert read.digest() == read_grid_message(payload(grid_message(made)), "k").digest()


@pytest.mark.parametrize("message", [LITTLE, BIG, ONE])
def test_a_message_that_ends_too_soon_is_refused_with_the_field(message: bytes) -> None:
    for length in range(2, len(message)):
        reason = _refused(message[:length])
        assert reason.startswith("neither JSON nor nav_msgs/OccupancyGrid in CDR: ")
        assert f"of {max(length, 4)}" in reason or length < 4
    assert "header.stamp would end at byte 12 of 6" in _refused(message[:6])
    assert "the length of header.frame_id would end at byte 16 of 14" in _refused(message[:14])
    assert "data would end at byte" in _refused(message[:-1])
    assert not is_grid_message(message[:1])


@settings(max_examples=examples(300), deadline=None)
@given(st.data())
@pytest.mark.seconds
def test_changed_bytes_give_a_map_or_a_reason(data: st.DataObject) -> None:
    changed = bytearray(data.draw(st.sampled_from([LITTLE, BIG])))
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(2, len(changed) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(InvalidMap):
        read = read_grid_message(bytes(changed), "k")
        again = read_grid_message(cdr_message(decode_map(read.encode())), "k")
        assert np.array_equal(again.cells, read.cells)


def test_other_messages_are_refused() -> None:
    assert _refused(TEXT).startswith("neither JSON nor nav_msgs/OccupancyGrid in CDR: ")
    assert _refused(SCAN)
    assert _refused(bytes(200)).startswith("it has 0 × 0 cells; a side has 1 to 10,000")
    assert _refused(b"\0\1").endswith("header.stamp would end at byte 12 of 4")
    for other in (b"\0\6\0\0", b"\0\2\0\0", b"\0\x0a\0\0"):
        assert not is_grid_message(other + LITTLE[4:]), "neither XCDR2 nor parameter lists"


def _with(at: int, layout: str, *values: float) -> bytes:
    changed = bytearray(LITTLE)
    struct.pack_into("<" + layout, changed, at, *values)
    return bytes(changed)


_FRAME, _RESOLUTION, _WIDTH, _ORIGIN, _TURN, _COUNT = 12, 28, 32, 44, 68, 100


def test_what_is_wrong_is_named_with_its_value() -> None:
    assert "header.frame_id would end at byte 4,294,967,311 of 110" in _refused(
        _with(_FRAME, "I", 2**32 - 1)
    )
    assert "header.frame_id does not end in a null" in _refused(_with(_FRAME + 7, "B", 65))
    assert "a side has 1 to 10,000" in _refused(_with(_WIDTH, "II", 2**32 - 1, 2**32 - 1))
    assert "it has 9,000 × 9,000 cells, more than" in _refused(_with(_WIDTH, "II", 9_000, 9_000))
    assert _refused(_with(_COUNT, "I", 5)) == "data: 5 values, where 3 × 2 cells take 6"
    assert _refused(_with(_COUNT, "I", 2**31)) == (
        "data: 2,147,483,648 values, where 3 × 2 cells take 6"
    )
    assert "data would end at byte 10,104 of 110" in _refused(
        _with(_WIDTH, "II", 100, 100)[:_COUNT] + struct.pack("<I", 10_000) + LITTLE[_COUNT + 4 :]
    )
    assert _refused(_with(_COUNT + 4, "b", 101)).startswith("data: value 101 at index 0; -1 is un")
    assert _refused(_with(_COUNT + 9, "b", -2)).startswith("data: value -2 at index 5; -1 is unkn")
    assert "resolution: Input should be greater" in _refused(_with(_RESOLUTION, "f", -0.05))
    assert "resolution or origin is NaN or infinite (got nan" in _refused(
        _with(_RESOLUTION, "f", math.nan)
    )
    assert "NaN or infinite (got 0.05, (inf," in _refused(_with(_ORIGIN, "d", math.inf))
    assert "is no turn about the vertical" in _refused(_with(_TURN, "d", 0.7))
    assert "4 bytes follow its last field" in _refused(LITTLE + bytes(4))


def test_what_a_message_declares_costs_nothing() -> None:
    """Sizes of gigabytes are compared with the bytes that are there."""
    begun = time.process_time()
    for _ in range(200):
        _refused(_with(_FRAME, "I", 2**32 - 1))
        _refused(_with(_COUNT, "I", 2**32 - 1))
        _refused(_with(_WIDTH, "II", 10_000, 1_600))
    assert time.process_time() - begun < 2.0


def test_the_largest_map_is_read() -> None:
    cells = np.random.default_rng(0).choice(np.array([0, 100, 255], np.uint8), (4000, 4000))
    large = OccupancyMap(None, 0.05, (0.0, 0.0, 0.0), "k", cells)
    assert read_grid_message(cdr_message(large), "k").digest() == large.digest()


@pytest.mark.parametrize(
    ("key", "named"),
    [
        ("tb/map", True),
        ("map", True),
        ("robot1/local_costmap/costmap", True),
        ("occupancy_grid", True),
        ("Map/5", True),
        ("0/walls/nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_8d348150c12913a31ee0ec170fbf2", True),
        ("tb/scan", False),
        ("maps/scan", False),
        ("map_updates", False),
        ("0/map/sensor_msgs::msg::dds_::LaserScan_/RIHS01_8d348150c12913a31ee0ec170fbf2", False),
        ("0/map/map_msgs::msg::dds_::OccupancyGridUpdate_/RIHS01_8d348150c12913a31ee", False),
        ("rt/odom", False),
        ("", False),
    ],
)
def test_a_key_names_a_grid_or_the_message_is_none(key: str, named: bool) -> None:
    assert names_grid(key) == named
    asked = [(key or "k", LITTLE)]
    (checked,) = check_payloads(asked, first=Offset(0), logged_ns=1, max_bytes=10_000)
    assert isinstance(checked.result, NewMap if named else Rejected)
    if isinstance(checked.result, Rejected):
        assert "does not name an occupancy grid" in checked.result.reason
    (checked,) = check_payloads(
        asked, first=Offset(0), logged_ns=1, max_bytes=10_000, are_grids=True
    )
    assert isinstance(checked.result, NewMap), "its type says so"


def test_no_other_message_of_ros_is_refused_as_a_grid() -> None:
    """Text in a message was read as "1,702,060,386 × 1,852,402,783 cells"."""
    said = b"\0\1\0\0" + b"rosgraph message of any other type, such as a log entry" * 4
    (checked,) = check_payloads([("rosout", said)], first=Offset(0), logged_ns=1, max_bytes=10_000)
    assert isinstance(checked.result, Rejected)
    assert "cells" not in checked.result.reason
    assert "--ros2dds" in checked.result.reason
