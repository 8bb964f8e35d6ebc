"""Where pictures and poses come from: folders, videos, messages of Zenoh."""

import itertools
import json
import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eventsrc.adapters.detector.picture import Picture, PictureError
from eventsrc.adapters.detector.picture_sources import NewestQueue, Timing, open_images, picture_of
from eventsrc.adapters.detector.poses import (
    LivePoses,
    MessageError,
    RobotPose,
    pose_of,
    poses_of_file,
)
from eventsrc.adapters.detector.vision import encode_jpeg
from eventsrc.base.errors import MisuseError
from eventsrc.record.transport.session import Received
from tests.support.drawn_pictures import compressed_image

PIXELS = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
JPEG = encode_jpeg(PIXELS)


def _stamps(pictures: Any) -> list[tuple[str, float]]:
    return [(Path(p.name).name, p.stamp_s) for p in pictures]


def test_a_folder_is_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    names = ("10.5.jpg", "10.25.jpg", "10.05.jpg", "9.25.JPG", "1403636579.jpeg", "notes.txt")
    for name in (*names, "1403636579763555584.png"):
        (tmp_path / name).write_bytes(JPEG)
    found = list(open_images(str(tmp_path), Timing()))
    assert _stamps(found) == [
        ("9.25.JPG", 9.25),
        ("10.05.jpg", 10.05),
        ("10.25.jpg", 10.25),
        ("10.5.jpg", 10.5),
        ("1403636579.jpeg", 1403636579.0),
        ("1403636579763555584.png", 1403636579.7635555),
    ]
    assert found[0].pixels().shape == (24, 32, 3)


def test_a_folder_at_a_rate(tmp_path: Path) -> None:
    for name in ("frame2.jpg", "frame10.jpg", "frame1.jpg"):
        (tmp_path / name).write_bytes(JPEG)
    found = _stamps(open_images(str(tmp_path), Timing(100.0, 4.0)))
    assert found == [("frame1.jpg", 100.0), ("frame2.jpg", 100.25), ("frame10.jpg", 100.5)]
    for name in ("frame1.jpg", "000017.jpg", "1.jpg", "12345678901.jpg", "1.jpg.jpg"):
        (tmp_path / name).write_bytes(JPEG)
        expected = rf"{re.escape(name)}: its name is no time; .* give --fps N"
        with pytest.raises(MisuseError, match=expected):
            list(open_images(str(tmp_path / name), Timing()))


def test_where_there_are_no_pictures(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(MisuseError, match=r"no \.jpg, \.jpeg or \.png in this folder"):
        open_images(str(tmp_path), Timing())
    with pytest.raises(MisuseError, match="no such folder or video"):
        open_images(str(tmp_path / "none"), Timing())
    (tmp_path / "film.mp4").write_bytes(b"no film")
    for data in (b"no film", b"", b"\0\0\0\x18ftypmp42" + bytes(500), b"RIFF\0\0\0\0AVI LIST"):
        (tmp_path / "film.mp4").write_bytes(data)
        with pytest.raises(MisuseError, match="cannot be opened as a video"):
            open_images(str(tmp_path / "film.mp4"), Timing())
    assert capfd.readouterr().err == ""


def test_a_video_counts_by_its_rate(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 8.0, (32, 24))
    for _ in range(5):
        writer.write(PIXELS)
    writer.release()
    pictures = open_images(str(path), Timing(50.0))
    found = [(p.stamp_s, p.pixels().shape) for p in pictures]
    assert found == [(50.0 + k / 8, (24, 32, 3)) for k in range(5)]


def test_poses_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("stamp,x,y,yaw\n1.0,0,0,0\n1.1,1,0,0.5\n")
    found = poses_of_file(path).at(1.05)
    assert found == pytest.approx(RobotPose(0.5, 0.0, 0.25))
    path.write_text("keyframe_id,x,y,yaw\n1,0,0,0\n")
    with pytest.raises(MisuseError, match="pictures need poses by stamp"):
        poses_of_file(path)


class Cdr:
    """Writes CDR as ROS does: the slow obvious way, a field at a time."""

    def __init__(self, order: str = "<") -> None:
        self.order, self.body = order, b""

    def add(self, kind: str, *values: Any) -> "Cdr":
        for value in values:
            size = struct.calcsize(kind)
            self.body += bytes(-len(self.body) % size) + struct.pack(self.order + kind, value)
        return self

    def text(self, text: str) -> "Cdr":
        data = text.encode() + b"\0"
        self.add("I", len(data))
        self.body += data
        return self

    def header(self, stamp: float, frame: str) -> "Cdr":
        whole = int(stamp)
        return self.add("i", whole).add("I", round((stamp - whole) * 1e9)).text(frame)

    @property
    def payload(self) -> bytes:
        return (b"\0\1\0\0" if self.order == "<" else b"\0\0\0\0") + self.body


def _pose_message(kind: str, order: str, frame: str) -> bytes:
    cdr = Cdr(order).header(12.5, frame)
    if kind == "Odometry":
        cdr.text("base_link")
    cdr.add("d", 1.5, -2.5, 0.1, 0.0, 0.0, math.sin(0.4), math.cos(0.4))
    if kind != "PoseStamped":
        cdr.add("d", *[0.01] * 36)
    if kind == "Odometry":
        cdr.add("d", *[0.3] * 42)
    return cdr.payload


@pytest.mark.parametrize("frame", ["", "map", "odom", "a/long/frame", "12345", "123456", "1234567"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped", "Odometry"])
def test_poses_of_ros(kind: str, order: str, frame: str) -> None:
    payload = _pose_message(kind, order, frame)
    stamp_s, pose = pose_of(payload, 99.0)
    assert stamp_s == 12.5
    assert pose == pytest.approx(RobotPose(1.5, -2.5, 0.8))
    assert pose_of(payload + b"\0\0\0", 99.0)[0] == 12.5
    passed = []
    for length in range(4, len(payload)):
        try:
            assert pose_of(payload[:length], 99.0) == (stamp_s, pose)
            passed.append(length)
        except MessageError:
            pass
    # A PoseWithCovarianceStamped cut to the length of a PoseStamped is one; so with 3 bytes more.
    assert len(passed) == (4 if kind == "PoseWithCovarianceStamped" else 0)


@pytest.mark.parametrize(
    ("document", "expected"),
    [
        ({"x": 1, "y": 2, "yaw": 3, "stamp": 4}, (4.0, RobotPose(1, 2, 3))),
        (
            {"map_x": 1.5, "map_y": 2, "map_yaw": 3, "timestamp": 4.5},
            (4.5, RobotPose(1.5, 2, 3)),
        ),
        ({"x": 1, "y": 2, "yaw": 3}, (99.0, RobotPose(1, 2, 3))),
        ({"x": 1, "y": 2}, None),
        ({"x": "1", "y": 2, "yaw": 3}, None),
        ({"x": True, "y": 2, "yaw": 3}, None),
        ({"x": math.nan, "y": 2, "yaw": 3}, None),
        ({"x": 1, "y": 2, "yaw": math.inf}, None),
        ({"x": 1e9, "y": 2, "yaw": 3}, None),
        ({"x": 10**400, "y": 2, "yaw": 3}, None),
        ({"x": 1, "y": 2, "yaw": 3, "stamp": -1}, None),
        ({"x": 1, "y": 2, "yaw": 3, "stamp": math.nan}, None),
        ([1, 2, 3], None),
    ],
)
def test_poses_of_json(document: Any, expected: Any) -> None:
    payload = json.dumps(document).encode()
    if expected is None:
        with pytest.raises(MessageError):
            pose_of(payload, 99.0)
    else:
        assert pose_of(payload, 99.0) == expected


@pytest.mark.parametrize("payload", [b"", b"{", b"[" * 100_000, b"\xff\xfe", b"\0\1\0\0"])
def test_what_is_no_pose(payload: bytes) -> None:
    with pytest.raises(MessageError):
        pose_of(payload, 99.0)


def test_pictures_of_zenoh() -> None:
    plain = picture_of(JPEG, "p", 99.0)
    assert (plain.stamp_s, plain.pixels().shape) == (99.0, (24, 32, 3))
    packed = picture_of(compressed_image(12.25, JPEG), "p", 99.0)
    assert packed.stamp_s == 12.25
    assert np.array_equal(packed.pixels(), plain.pixels())
    by_hand = Cdr().header(12.25, "camera").text("jpeg").add("I", len(JPEG)).payload + JPEG
    assert by_hand == compressed_image(12.25, JPEG)
    without_stamp = Cdr().header(0.0, "").text("jpeg").add("I", len(JPEG)).payload + JPEG
    assert picture_of(without_stamp, "p", 99.0).stamp_s == 99.0


def _raw(encoding: str, rows: "np.ndarray[Any, Any]", step: int, order: str = "<") -> bytes:
    height, width = rows.shape[:2]
    padded = np.zeros((height, step), np.uint8)
    padded[:, : rows[0].size] = rows.reshape(height, -1)
    cdr = Cdr(order).header(3.5, "camera").add("I", height, width).text(encoding).add("B", 0)
    return cdr.add("I", step, padded.size).payload + padded.tobytes()


@pytest.mark.parametrize("order", ["<", ">"])
def test_raw_pictures_of_ros(order: str) -> None:
    for encoding, rows in (("bgr8", PIXELS), ("rgb8", PIXELS[:, :, ::-1])):
        found = picture_of(_raw(encoding, rows, 100, order), "p", 99.0)
        assert found.stamp_s == 3.5
        assert np.array_equal(found.pixels(), PIXELS)
    grey = picture_of(_raw("mono8", PIXELS[:, :, 0], 32, order), "p", 99.0).pixels()
    assert np.array_equal(grey[:, :, 2], PIXELS[:, :, 0])
    with pytest.raises(MessageError, match="encoding '16UC1'"):
        picture_of(_raw("16UC1", PIXELS, 100, order), "p", 99.0)


def test_messages_that_are_cut_never_pass() -> None:
    for payload in (compressed_image(1.0, JPEG), _raw("bgr8", PIXELS, 96)):
        for length in itertools.chain(range(4, 80), range(80, len(payload), 211)):
            with pytest.raises((MessageError, PictureError)):
                picture_of(payload[:length], "p", 99.0).pixels()


def test_the_newest_pictures_win() -> None:
    queue = NewestQueue(3)
    for number in range(10):
        queue.put(Received("k", bytes([number])), float(number))
    assert queue.dropped == 7
    got = [queue.get(0.0) for _ in range(3)]
    assert [each[0].payload[0] for each in got if each is not None] == [7, 8, 9]
    assert queue.get(0.0) is None
    queue.put(Received("k", b""), 0.0)
    queue.close()
    assert (queue.get(0.0), queue.dropped) == (None, 8)


def test_live_poses_are_read_when_asked() -> None:
    poses = LivePoses()
    for stamp in (2.0, 1.0, 1.1):
        poses.put(json.dumps({"x": stamp, "y": 0, "yaw": 0, "stamp": stamp}).encode(), 0.0)
    poses.put(b"nonsense", 0.0)
    assert poses.at(1.05) == pytest.approx(RobotPose(1.05, 0, 0))
    assert (poses.count, poses.bad) == (3, 1)
    assert poses.bad_reason is not None
    assert poses.at(50.0) is None  # after a tenth of a second


def _pose(stamp: float, size: int = 0) -> bytes:
    document = {"x": stamp, "y": 0, "yaw": 0, "stamp": stamp, "frame": "f" * size}
    return json.dumps(document).encode()


def test_unread_live_poses_stay_within_bounds_of_number_and_bytes() -> None:
    for size in (0, 60_000):
        poses = LivePoses()
        for number in range(30_000 if not size else 1_000):
            poses.put(_pose(float(number), size), 0.0)
        kept = [payload for payload, _ in poses._messages]
        assert len(kept) <= 20_000
        assert sum(map(len, kept)) == poses._bytes <= 16 * 1024 * 1024
        assert poses.dropped == (30_000 if not size else 1_000) - len(kept) > 0
        last = 29_999.0 if not size else 999.0
        assert poses.at(last) == RobotPose(last, 0, 0)  # the newest are kept
        assert poses._bytes == 0


def test_one_pose_far_in_the_future_does_not_end_the_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The pose of the picture comes after it, as the robot's next one always does."""
    poses = LivePoses()
    for stamp in (1.0, 99_999.0):
        poses.put(_pose(stamp), 0.0)
    assert poses.at(1.0) == RobotPose(1.0, 0, 0)
    monkeypatch.setattr(poses._came, "wait", lambda _left: poses.put(_pose(1.05), 0.0))
    assert poses.at(1.02) == pytest.approx(RobotPose(1.02, 0, 0))


def test_poses_that_are_all_later_are_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Those of a slow localiser, when pictures of a moment ago are looked at."""
    poses = LivePoses()
    for stamp in (1.0, 2.0, 3.0):
        poses.put(_pose(stamp), 0.0)
    monkeypatch.setattr(poses._came, "wait", lambda _left: pytest.fail("it waits"))
    for number in range(50):
        assert poses.at(1.2 + 0.01 * number) is None


def test_a_picture_is_a_value() -> None:
    picture = Picture("p", 1.0, lambda: PIXELS)
    assert picture.pixels() is PIXELS
