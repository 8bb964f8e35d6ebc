"""Crops of detections that are kept from the pictures of a bag or of a bridge from ROS."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from eventsrc.adapters.detector.keyframes import crops_of_message
from eventsrc.adapters.detector.vision import decode
from eventsrc.base.errors import MisuseError
from eventsrc.envelope.crops import CROPS_TOPIC, decode_crop
from eventsrc.record.importers.ros_bags import BagReport
from eventsrc.record.recorder.bridged import Bridge
from eventsrc.record.transport.session import Session
from projections.surfaces.cli.bag_text import BagChoice, stream_lines
from projections.surfaces.cli.bridge_options import BridgeChoice, recording_of
from tests.support import ros2dds
from tests.support import ros_messages as ros
from tests.support.fixtures_log import read_log
from tests.support.ros2dds import KINDS
from tests.support.ros2dds_recordings import (
    announce_all,
    choice,
    recording,
    send_all,
    verbatim,
)
from tests.support.ros_bags import Drive, Raw, Recorded, imported, write_bag
from tests.support.ros_messages import SECOND, TYPES, make

COMPRESSED, IMAGE = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
DRIVE = Drive(12)
SIZE = 480, 640
FIRST = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()


def colour(number: int, index: int) -> tuple[int, int, int]:
    """Blue, green and red of a box, far from those of others."""
    return (60 + 15 * number) % 256, 250 - 100 * index, (40 * number) % 256


def pixels(number: int, boxes: list[list[float]]) -> np.ndarray[Any, Any]:
    """A black picture with a box of its own colour for each detection."""
    shown = np.zeros((*SIZE, 3), np.uint8)
    for index, (x0, y0, x1, y1) in enumerate(boxes):
        shown[int(y0) : int(y1), int(x0) : int(x1)] = colour(number, index)
    return shown


def compressed(stamp_ns: int, data: bytes) -> Any:
    named = ros.header(stamp_ns, "camera_optical")
    return make(COMPRESSED, header=named, format="jpeg", data=np.frombuffer(data, np.uint8))


def raw(stamp_ns: int, shown: np.ndarray[Any, Any], **wrong: Any) -> Any:
    height, width = shown.shape[:2]
    fields = {"height": height, "width": width, "encoding": "bgr8", "is_bigendian": 0}
    fields |= {"step": 3 * width, "data": shown.reshape(-1)} | wrong
    return make(IMAGE, header=ros.header(stamp_ns, "camera_optical"), **fields)


def jpeg(shown: np.ndarray[Any, Any]) -> bytes:
    return bytes(cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


def boxes_of(message: Any) -> list[list[float]]:
    found = []
    for each in message.detections:
        at, box = each.bbox.center.position, each.bbox
        half_x, half_y = box.size_x / 2, box.size_y / 2
        found.append([at.x - half_x, at.y - half_y, at.x + half_x, at.y + half_y])
    return found


def with_pictures(made: Callable[[int, int, list[list[float]]], Any]) -> Iterator[Recorded]:
    """The messages of a drive, and before those of each picture's detections ``made`` of its
    number, stamp and boxes."""
    number = 0
    for topic, received_ns, message in DRIVE.messages():
        if topic == "/detections":
            stamp_ns = DRIVE.shown_at(number)
            yield "/camera/image", stamp_ns, made(number, stamp_ns, boxes_of(message))
            number += 1
        yield topic, received_ns, message


def compressed_pictures() -> Iterator[Recorded]:
    return with_pictures(lambda n, stamp, boxes: compressed(stamp, jpeg(pixels(n, boxes))))


def raw_pictures() -> Iterator[Recorded]:
    return with_pictures(lambda n, stamp, boxes: raw(stamp, pixels(n, boxes)))


def crops_in(log: Path) -> dict[str, np.ndarray[Any, Any]]:
    """The crops of a log by det_id."""
    found = [decode_crop(event.payload) for event in read_log(log) if event.key == CROPS_TOPIC]
    assert len({crop.det_id for crop in found}) == len(found)
    return {crop.det_id: decode(crop.jpeg) for crop in found}


def check_crops(crops: dict[str, np.ndarray[Any, Any]], run_id: str, numbers: range) -> None:
    """Each detection of these keyframes has a crop in the colour of its box, and no other has."""
    expected = {
        f"{run_id}_kf{number}_d{index}": colour(number, index)
        for number in numbers
        for index in range(len(list(DRIVE._seen(number))))
    }
    assert crops.keys() == expected.keys()
    # A later box may cover an earlier one in part, so the last one of a picture is compared.
    last = {name.rpartition("_d")[0]: name for name in expected}
    for name in last.values():
        middle = crops[name][20:40, 10:30].reshape(-1, 3).mean(axis=0)
        assert np.abs(middle - expected[name]).max() < 8


def only_bag(report: Any) -> BagReport:
    (bag,) = report.bags
    return bag  # type: ignore[no-any-return]


@pytest.mark.parametrize("messages", [compressed_pictures, raw_pictures])
def test_crops_of_a_bag_are_of_their_detections(
    tmp_path: Path, messages: Callable[[], Iterator[Recorded]]
) -> None:
    bag, log = write_bag(tmp_path / "drive", messages()), tmp_path / "log"
    report = imported(log, bag, cut=crops_of_message)
    crops = crops_in(log)
    check_crops(crops, "drive-20240501T100000", range(12))
    counts = only_bag(report).streams["/detections"]
    assert (counts.crops, counts.without_picture, counts.outside) == (len(crops), 0, 0)
    assert f"{len(crops)} crops" in "\n".join(stream_lines({"/detections": counts}))


def test_without_keeping_them_pictures_are_not_used(tmp_path: Path) -> None:
    bag, log = write_bag(tmp_path / "drive", compressed_pictures()), tmp_path / "log"
    report = imported(log, bag)
    assert crops_in(log) == {}
    topics = {each.topic: each.used_for for each in only_bag(report).topics}
    assert topics["/camera/image"] == ""


def hostile(number: int, stamp_ns: int, boxes: list[list[float]]) -> Any:
    good = pixels(number, boxes)
    bomb = bytearray(jpeg(good))
    at = bomb.index(b"\xff\xc0") + 5
    bomb[at : at + 4] = b"\xff\xff\xff\xff"
    return [
        lambda: compressed(stamp_ns, jpeg(good)[:-500]),
        lambda: compressed(stamp_ns, bytes(bomb)),
        lambda: compressed(stamp_ns, b""),
        lambda: raw(stamp_ns, good, step=5),
        lambda: raw(stamp_ns, good, height=2**32 - 1, width=2**32 - 1),
        lambda: raw(stamp_ns, good, data=good.reshape(-1)[:-1]),
        lambda: raw(stamp_ns, good, encoding="16UC1"),
        lambda: Raw(IMAGE, b"\0\1"),
        lambda: Raw(IMAGE, b"no cdr at all"),
        lambda: compressed(stamp_ns + SECOND, jpeg(good)),
    ][number % 10]()


@pytest.mark.parametrize("kinds", [(0, 1, 2), (3, 4, 5, 6), (7, 8, 9)])
def test_hostile_pictures_are_counted_and_the_import_goes_on(
    tmp_path: Path, kinds: tuple[int, ...]
) -> None:
    """No keyframe is lost by them, and the crops of the others are kept."""
    types = {COMPRESSED: "/compressed", IMAGE: "/raw"}
    name = types[COMPRESSED if kinds[0] == 0 else IMAGE]

    def messages() -> Iterator[Recorded]:
        def made(number: int, stamp: int, boxes: list[list[float]]) -> Any:
            if number < 6:
                shown = hostile(kinds[number % len(kinds)], stamp, boxes)
                if shown.__msgtype__ == (COMPRESSED if kinds[0] == 0 else IMAGE):
                    return shown
                return raw(stamp + SECOND, pixels(number, boxes))
            good = pixels(number, boxes)
            return compressed(stamp, jpeg(good)) if kinds[0] == 0 else raw(stamp, good)

        for topic, received_ns, message in with_pictures(made):
            yield (name if topic == "/camera/image" else topic), received_ns, message

    bag, log = write_bag(tmp_path / "drive", messages()), tmp_path / "log"
    report = imported(log, bag, cut=crops_of_message)
    assert report.accepted == 12
    assert report.rejected == 0
    check_crops(crops_in(log), "drive-20240501T100000", range(6, 12))
    counts = only_bag(report).streams["/detections"]
    with_detections = sum(bool(list(DRIVE._seen(number))) for number in range(6))
    bad = counts.unused.get(name, 0)
    assert bad + counts.without_picture >= with_detections
    assert bad > 0
    assert counts.reasons[name]


def test_a_box_outside_the_picture_has_no_crop() -> None:
    message = compressed(1, jpeg(np.full((40, 60, 3), 200, np.uint8)))
    payload = bytes(TYPES.encode(message, COMPRESSED))
    crops = crops_of_message(payload, [[70, 10, 90, 20], [-5, -5, 10, 10], [50, 30, 1e9, 1e9]])
    assert crops[0] is None
    assert [decode(crop).shape for crop in crops[1:] if crop] == [(10, 10, 3), (10, 10, 3)]
    assert crops_of_message(payload, [[float("nan"), 0, 1, 1], [0, 0, 9, 9]]) == [None, None]


def test_a_bridge_cuts_crops_and_does_not_keep_the_pictures(
    log_path: Path, endpoint: str, connected: Callable[[], Session]
) -> None:
    sent = []
    for topic, message in ros2dds.drive(6):
        if topic == "/detections":
            stamp = message.header.stamp
            stamp_ns = stamp.sec * SECOND + stamp.nanosec
            shown = np.full((*SIZE, 3), 90, np.uint8)
            sent.append(("/image", compressed(stamp_ns, jpeg(shown))))
        sent.append((topic, message))
    ros_recording, topics = recording_of(choice(keep_crops=True, images="/image"), 0, None)
    own = Bridge(ros_recording, topics, TYPES, cut=crops_of_message)
    with (
        ros2dds.bridge(endpoint) as bridge,
        recording(connected(), log_path, own) as running,
    ):
        announce_all(bridge)
        bridge.advertise("/image", latched=False)
        running.wait_until(lambda _: len(own.types_known) >= len(KINDS))
        send_all(bridge, sent)
        running.wait_until(lambda r: r.crops >= 6)
    report = running.finish()
    assert (report.crops, report.lost, report.rejected) == (6, 0, 0)
    assert sorted(crops_in(log_path)) == [f"drive_kf{number}_d0" for number in range(6)]
    assert not [event for event in verbatim(read_log(log_path)) if event.key == "/image"]
    assert own.derivation.counts["/detections"].crops == 6


def test_options_that_lack_something_are_refused() -> None:
    with pytest.raises(MisuseError, match="give --images TOPIC too"):
        recording_of(BridgeChoice(keep_crops=True), 0, None)
    with pytest.raises(MisuseError, match="give --keep-crops too"):
        BagChoice(images="/camera/image").options()
