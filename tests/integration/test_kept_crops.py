"""Crops of detections that are kept from the pictures of a bag or of a bridge from ROS."""

import json
from base64 import b64decode
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import Request, urlopen

import numpy as np
import pytest
from starlette.datastructures import QueryParams

from eventsrc.adapters.detector.keyframes import crops_of_message
from eventsrc.adapters.detector.vision import decode, encode_jpeg
from eventsrc.base.errors import MisuseError
from eventsrc.envelope.crops import (
    CROPS_TOPIC,
    MAX_CROP_BYTES,
    Crop,
    decode_crop,
    encode_crop,
)
from eventsrc.envelope.model import DetId, Offset
from eventsrc.log import NEVER, LogReader, LogWriter
from eventsrc.record.importers.ros_bags import BagReport
from eventsrc.record.recorder.bridged import Bridge
from eventsrc.record.transport.session import Session
from projections.ask.best_views import views_in_order
from projections.ask.kept_crops import KeptCrops
from projections.fold.map_errors import QuestionError
from projections.fold.presets import PRESETS
from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.store.tables import Tables
from projections.surfaces.cli.bag_text import BagChoice, stream_lines
from projections.surfaces.cli.bridge_options import BridgeChoice, recording_of
from projections.surfaces.python import fold
from projections.surfaces.serve import Answerer, FairQueue, Pools
from projections.surfaces.serve.asked import ServedLog
from projections.surfaces.ui.crop_pictures import pictures_answer
from projections.surfaces.ui.log_map import LogMap, Opened
from tests.support import ros2dds
from tests.support import ros_messages as ros
from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.fixtures_log import read_log
from tests.support.logs import write_log
from tests.support.models import FORMAT
from tests.support.ros2dds import KINDS
from tests.support.ros2dds_recordings import (
    announce_all,
    choice,
    recording,
    send_all,
    verbatim,
)
from tests.support.ros_bags import CAMERA, Drive, Raw, Recorded, imported, write_bag
from tests.support.ros_messages import SECOND, TYPES, make
from tests.support.serve_questions import DEADLINE_S, http_at

COMPRESSED, IMAGE = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
DRIVE = Drive(12)
SIZE = 480, 640
FIRST = encode_jpeg(np.zeros((8, 8, 3), np.uint8))


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
    return with_pictures(lambda n, stamp, boxes: compressed(stamp, encode_jpeg(pixels(n, boxes))))


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
    bomb = bytearray(encode_jpeg(good))
    at = bomb.index(b"\xff\xc0") + 5
    bomb[at : at + 4] = b"\xff\xff\xff\xff"
    return [
        lambda: compressed(stamp_ns, encode_jpeg(good)[:-500]),
        lambda: compressed(stamp_ns, bytes(bomb)),
        lambda: compressed(stamp_ns, b""),
        lambda: raw(stamp_ns, good, step=5),
        lambda: raw(stamp_ns, good, height=2**32 - 1, width=2**32 - 1),
        lambda: raw(stamp_ns, good, data=good.reshape(-1)[:-1]),
        lambda: raw(stamp_ns, good, encoding="16UC1"),
        lambda: Raw(IMAGE, b"\0\1"),
        lambda: Raw(IMAGE, b"no cdr at all"),
        lambda: compressed(stamp_ns + SECOND, encode_jpeg(good)),
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
            return compressed(stamp, encode_jpeg(good)) if kinds[0] == 0 else raw(stamp, good)

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
    message = compressed(1, encode_jpeg(np.full((40, 60, 3), 200, np.uint8)))
    payload = bytes(TYPES.encode(message, COMPRESSED))
    crops = crops_of_message(payload, [[70, 10, 90, 20], [-5, -5, 10, 10], [50, 30, 1e9, 1e9]])
    assert crops[0] is None
    assert [decode(crop).shape for crop in crops[1:] if crop] == [(10, 10, 3), (10, 10, 3)]
    assert crops_of_message(payload, [[float("nan"), 0, 1, 1], [0, 0, 9, 9]]) == [None, None]


def test_find_and_python_give_the_best_view(tmp_path: Path) -> None:
    """Of an Object's crops that of the largest, surest box that is whole in the picture."""
    bag, log = write_bag(tmp_path / "drive", compressed_pictures()), tmp_path / "log"
    imported(log, bag, cut=crops_of_message)
    house = fold(log, preset="full")
    mapfold = Commands.in_folder(tmp_path)
    words = ("find", "log", "--preset", "full", "--all", "--crops", "crops")
    found = mapfold(*words, "--json").json["answers"]
    assert found
    by_id = {each.object_id: each for each in house.view.objects.values()}
    for answer in found:
        numbers = by_id[answer["object_id"]].observations
        seen = [house.view.observations[number] for number in numbers]
        best = max(seen, key=lambda one: (one.confidence, -one.ordinal))  # all boxes are equal
        jpeg = (tmp_path / answer["crop"]).read_bytes()
        assert jpeg == stored(log)[best.det_id] == house.crops(answer["object_id"])[0]
        assert len(house.crops(answer["object_id"])) == len(seen)
    said = mapfold(*words)
    assert all(answer["crop"] in said.out for answer in found)
    assert "--crops needs the LOG" in mapfold("find", "--db", "", "--crops", "crops", code=2).err


def test_the_page_and_why_show_the_crops_that_are_the_evidence(tmp_path: Path) -> None:
    bag, log = write_bag(tmp_path / "drive", compressed_pictures()), tmp_path / "log"
    imported(log, bag, cut=crops_of_message)
    kept, view = stored(log), fold(log, preset="full").view
    full = Settings(**dict(text.split("=") for text in PRESETS["full"]))
    one = max(view.objects.values(), key=lambda each: each.obs_count)
    best = [each.det_id for each in views_in_order(view, one)]

    def shown(what: str) -> list[dict[str, Any]]:
        with LogMap(Opened(log, lambda _: full)) as opened:
            opened.refresh()
            found = pictures_answer(opened, QueryParams({"what": what}))["pictures"]
        assert [b64decode(each["jpeg"]) for each in found] == [kept[e["det_id"]] for e in found]
        return list(found)

    assert [each["det_id"] for each in shown(f"object:{one.object_id}")] == best[:8]
    first = view.keyframes[view.observations[one.observations[0]].keyframe]
    of_it = shown(f"keyframe:{first.run_id}/{first.keyframe_id}")
    seen = [view.observations[number] for number in first.observations]
    assert [(e["det_id"], e["bbox"]) for e in of_it] == [(e.det_id, list(e.bbox)) for e in seen]
    for hostile in ("object:../../etc", "place:p0", "keyframe:x", "object:", ""):
        with pytest.raises((MisuseError, QuestionError)):
            shown(hostile)

    words = ("why", "log", one.object_id, "--preset", "full", "--crops", "crops")
    mapfold = Commands.in_folder(tmp_path)
    found = mapfold(*words, "--json").json["crops"]
    assert [each["det_id"] for each in found] == best[:16]
    assert all((tmp_path / e["file"]).read_bytes() == kept[e["det_id"]] for e in found)
    said = mapfold(*words).out
    assert all(f"{each['file']}: {each['det_id']}, offset" in said for each in found)
    refused = mapfold("why", "log", "p0", "--crops", "crops", code=2).err
    assert "--crops writes those of an object" in refused


def stored(log: Path) -> dict[str, bytes]:
    found = [decode_crop(event.payload) for event in read_log(log) if event.key == CROPS_TOPIC]
    return {crop.det_id: crop.jpeg for crop in found}


def test_boxes_at_the_edge_come_last(tmp_path: Path) -> None:
    log = tmp_path / "log"
    boxes = [[0, 50, 300, 300], [100, 100, 150, 150], [300, 200, 640, 480], [100, 100, 160, 160]]
    write_log(
        log,
        [
            envelope(number, detections=[detection(vector=[1.0, 0.0], bbox=box)], camera=CAMERA)
            for number, box in enumerate(boxes)
        ],
    )
    view = fold(log).view
    (only,) = view.objects.values()
    order = [view.keyframes[each.keyframe].keyframe_id for each in views_in_order(view, only)]
    assert order == [3, 1, 2, 0]


def got(url: str, headers: dict[str, str] | None = None) -> tuple[int, Any, bytes]:
    """Status, headers and body of an answer."""
    try:
        with urlopen(Request(url, headers=headers or {}), timeout=DEADLINE_S) as answer:
            return answer.status, answer.headers, answer.read()
    except HTTPError as refused:
        return refused.code, refused.headers, refused.read()


@pytest.mark.parametrize(
    "crop",
    [
        Crop(DetId("a"), b"<html><script>"),
        Crop(DetId("a"), FIRST[:-40]),
        Crop(DetId("a"), FIRST[:-2] + bytes(MAX_CROP_BYTES) + FIRST[-2:]),
        Crop(DetId(""), FIRST),
        Crop(DetId(300 * "a"), FIRST),
    ],
)
def test_what_others_write_to_the_topic_is_no_crop(tmp_path: Path, crop: Crop) -> None:
    """A recorder keeps messages of any publisher. Of two of one detection the first is kept."""
    other = encode_jpeg(np.full((9, 9, 3), 80, np.uint8))
    with LogWriter(tmp_path / "log", fsync=NEVER) as writer:
        for each in (crop, Crop(DetId("a"), FIRST), Crop(DetId("a"), other)):
            writer.append(CROPS_TOPIC, encode_crop(each, 1), form=FORMAT)
    with LogReader(tmp_path / "log") as reader:
        assert KeptCrops(reader).jpeg(crop.det_id) == (FIRST if crop.det_id == "a" else None)
        assert KeptCrops(reader).jpeg("a", Offset(0)) == FIRST


@pytest.mark.parametrize("command", ["find", "why"])
def test_a_folder_of_crops_that_cannot_be_written_is_refused(tmp_path: Path, command: str) -> None:
    bag, log = write_bag(tmp_path / "drive", compressed_pictures()), tmp_path / "log"
    imported(log, bag, cut=crops_of_message)
    one = next(iter(fold(log, preset="full").view.objects.values())).object_id
    mapfold = Commands.in_folder(tmp_path)
    words = command, "log", one, "--preset", "full", "--crops"
    (tmp_path / "file").write_bytes(b"mine")
    assert "cannot be written: " in mapfold(*words, "file", code=2).err
    assert (tmp_path / "file").read_bytes() == b"mine"
    named = f"{one}.jpg" if command == "find" else f"{one}-1.jpg"
    (tmp_path / "taken" / named).mkdir(parents=True)
    assert "cannot be written: Is a directory" in mapfold(*words, "taken", code=2).err
    assert [each.name for each in (tmp_path / "taken").iterdir()] == [named]


def test_http_gives_crops_of_detections_and_objects(
    tmp_path: Path, module_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag, log = write_bag(tmp_path / "drive", compressed_pictures()), tmp_path / "log"
    imported(log, bag, cut=crops_of_message)
    rebuild(log, module_database, Settings())
    kept = stored(log)
    with Pools(module_database, 2) as pools, FairQueue(2) as queue, ExitStack() as stack:
        beside = stack.enter_context(closing(ServedLog(log)))
        answerer = Answerer(pools, per_second=1000.0, log=beside)
        with http_at(answerer, queue) as port:
            at = f"http://127.0.0.1:{port}/crops/"
            for det_id, jpeg in kept.items():
                status, headers, content = got(at + quote(det_id, safe=""))
                assert (status, content) == (200, jpeg)
                assert headers["content-type"] == "image/jpeg"
                assert headers["cache-control"] == "private, no-cache"
                again = got(at + quote(det_id, safe=""), {"If-None-Match": headers["etag"]})
                assert (again[0], again[2]) == (304, b"")
            one = next(iter(fold(log).view.objects.values()))
            assert got(at + one.object_id)[2] in kept.values()
            for hostile in (
                "../../etc/passwd",
                "%2e%2e%2f%2e%2e%2fetc",
                "obj-",
                "a%00b",
                "x" * 300,
            ):
                status, _, content = got(at + hostile)
                assert status in (400, 404), hostile
                assert json.loads(content)["error"]["kind"] == "bad_question"
            with monkeypatch.context() as patched:  # of a log that did not grow no id is read again
                patched.delattr(Tables, "texts")
                assert got(at + "unknown")[0] == 404
                assert got(at + quote(next(iter(kept)), safe=""))[0] == 200
            without = Answerer(pools, per_second=1000.0)
            with pytest.raises(QuestionError, match="start the service with --log LOG"):
                without.crop(next(iter(kept)))


def test_a_bridge_cuts_crops_and_does_not_keep_the_pictures(
    log_path: Path, endpoint: str, connected: Callable[[], Session]
) -> None:
    sent = []
    for topic, message in ros2dds.drive(6):
        if topic == "/detections":
            stamp = message.header.stamp
            stamp_ns = stamp.sec * SECOND + stamp.nanosec
            shown = np.full((*SIZE, 3), 90, np.uint8)
            sent.append(("/image", compressed(stamp_ns, encode_jpeg(shown))))
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
