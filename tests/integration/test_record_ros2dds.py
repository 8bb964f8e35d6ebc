"""Recording what a zenoh-bridge-ros2dds sends, over real sessions: messages verbatim, envelopes of
them right behind, whatever comes late, twice, broken or not at all."""

import json
import math
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.system_events import MAP_KEY, REJECTED_KEY, ROS_KEY
from eventsrc.log import LogReader, LogWriter, MessageFormat, NewEvent, verify_log
from eventsrc.record.importers.bag_streams import BagOptions
from eventsrc.record.importers.run import import_files
from eventsrc.record.recorder.queue import BridgedMessage
from eventsrc.record.transport.session import Session, ZenohOptions, open_session
from eventsrc.ros.derivation import read_recording
from eventsrc.ros.wire import topic_of
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from tests.support import ros2dds
from tests.support.fixtures_log import read_log
from tests.support.fixtures_zenoh import LONG_LEASE
from tests.support.ros2dds import BOXES, KINDS, Sent, drive
from tests.support.ros2dds_recordings import (
    announce_all,
    check_derived,
    digest,
    envelopes,
    expected_envelopes,
    new_bridge,
    recording,
    send_all,
    verbatim,
    wait_for_recorder,
)
from tests.support.ros_bags import write_bag
from tests.support.ros_messages import (
    START,
    TYPES,
    box,
    detection,
    detections,
    label_info,
    parameter_event,
    vision_info,
)

Sessions = Callable[[], Session]


@pytest.mark.parametrize(("old", "namespace"), [(False, "/bot1"), (True, ""), (False, "/a/b/")])
def test_messages_are_verbatim_and_make_the_envelopes_of_a_bag(
    log_path: Path, endpoint: str, connected: Sessions, old: bool, namespace: str
) -> None:
    sent = drive(40)
    with (
        ros2dds.bridge(endpoint, namespace=namespace, old=old) as bridge,
        recording(connected(), log_path, own := new_bridge(namespace)) as running,
    ):
        announce_all(bridge)
        running.wait_until(lambda _: len(own.types_known) == len(KINDS))
        payloads = send_all(bridge, sent)
        running.wait_until(lambda r: r.messages >= len(sent))
    report = running.finish()
    assert (report.recorded, report.messages, report.lost) == (41, len(sent), 0)  # 40, and a map
    assert report.clean
    events = read_log(log_path)
    kept = verbatim(events)
    assert [(e.key, e.payload) for e in kept] == [
        (topic_of(namespace, name, ""), payload) for name, payload in payloads
    ]
    for event, (name, _) in zip(kept, payloads, strict=True):
        text = TYPES.definition(KINDS[name]).encode()
        assert event.format == MessageFormat("cdr", KINDS[name], "ros2msg", text)
    expected = expected_envelopes(sent, namespace)
    assert [e.payload for e in envelopes(events)] == expected
    assert all(b'"embedding"' in each and b'"map_x"' in each for each in expected)
    check_derived(log_path)
    assert verify_log(log_path).findings == ()
    assert [read_recording(e.payload).streams == () for e in events if e.key == ROS_KEY] == [
        False,
        True,
    ]


def record_drive(keyframes: int, session: Session, log: Path, endpoint: str) -> Sent:
    """Record the messages of a drive from a bridge; returns them."""
    sent = drive(keyframes)
    with ros2dds.bridge(endpoint) as bridge, recording(session, log, new_bridge()) as running:
        announce_all(bridge)
        send_all(bridge, sent)
        running.wait_until(lambda r: r.messages >= len(sent))
    return sent


def test_the_map_is_that_of_the_envelopes_alone(
    log_path: Path, tmp_path: Path, endpoint: str, connected: Sessions
) -> None:
    record_drive(30, connected(), log_path, endpoint)
    alone = tmp_path / "alone"
    with LogWriter(alone) as writer:
        for event in read_log(log_path):
            if event.is_envelope or event.key == MAP_KEY:
                times = event.logged_ns, event.stamp_ns
                writer.append_all([NewEvent(event.key, event.payload, *times)])
    assert digest(log_path) == digest(alone)
    with LogReader(log_path) as reader:
        view = fold_log(reader, Settings())[1]
    assert len(view.places) >= 2


def test_a_bag_of_the_same_messages_makes_the_same_envelopes_and_map(
    log_path: Path, tmp_path: Path, endpoint: str, connected: Sessions
) -> None:
    sent = record_drive(25, connected(), log_path, endpoint)
    times = range(START, START + len(sent))
    bag = write_bag(tmp_path / "bag", [(t, n, m) for n, (t, m) in zip(times, sent, strict=True)])
    with LogWriter(tmp_path / "of-bag") as writer:
        import_files(writer, [str(bag)], bags=BagOptions(run_id="drive"))
    imported = read_log(tmp_path / "of-bag")
    assert [e.payload for e in envelopes(imported)] == [
        e.payload for e in envelopes(read_log(log_path))
    ]
    assert digest(tmp_path / "of-bag") == digest(log_path)


@pytest.mark.parametrize("old", [False, True])
def test_what_a_bridge_keeps_for_who_comes_late_is_recorded(
    log_path: Path, endpoint: str, connected: Sessions, old: bool
) -> None:
    sent = drive(6)
    with ros2dds.bridge(endpoint, namespace="bot1", old=old) as bridge:
        announce_all(bridge)
        bridge.send("/tf_static", sent[0][1])  # long before the recorder
        bridge.send("/map", sent[1][1])
        with recording(connected(), log_path, new_bridge("bot1")) as running:
            send_all(bridge, sent[2:])
            running.wait_until(lambda r: r.messages >= len(sent))
    assert [e.payload for e in envelopes(read_log(log_path))] == expected_envelopes(sent, "bot1")
    assert sum(event.key == MAP_KEY for event in read_log(log_path)) == 1
    check_derived(log_path)


@pytest.mark.parametrize(
    ("told", "is_latched"),
    [
        ({"/label_info": label_info(START, {3: "cup", 4: "mug"})}, True),
        ({"/parameter_events": parameter_event("/yolo", {"labels.3": "cup"})}, False),
        (
            {
                "/vision_info": vision_info(START, "yolo/table_9"),
                "/parameter_events": parameter_event("/yolo", {"table_9": [*"abc", "cup"]}),
            },
            False,
        ),
    ],
)
def test_classes_have_the_names_that_a_robot_tells(
    log_path: Path, endpoint: str, connected: Sessions, told: dict[str, Any], is_latched: bool
) -> None:
    seen = detection([("3", 0.9)], box(9, 9, 2, 2))
    shown = detections(START, "camera", seen)
    topics = tuple(told)
    own = new_bridge("bot1", classes=topics, embeddings=None, pose="none", grid="none")
    with ros2dds.bridge(endpoint, namespace="bot1") as bridge:
        bridge.advertise("/detections")
        bridge.announce("/detections", BOXES)
        for topic, message in told.items():
            bridge.advertise(topic, latched=is_latched)
            bridge.announce(topic, message.__msgtype__, latched=is_latched)
            if is_latched:
                bridge.send(topic, message)  # long before the recorder
        with recording(connected(), log_path, own) as running:
            names = [] if is_latched else [*told.items()]
            send_all(bridge, [("/detections", shown), *names])
            running.wait_until(lambda r: r.messages >= 1 + len(told))
    (made,) = envelopes(read_log(log_path))
    assert [each["class"] for each in json.loads(made.payload)["detections"]] == ["cup"]
    assert {event.key for event in verbatim(read_log(log_path))} == {
        f"/bot1{topic}" for topic in ("/detections", *told)
    }
    check_derived(log_path)


def test_a_bridge_that_is_a_router_itself(log_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        where = f"tcp/127.0.0.1:{server.getsockname()[1]}"
    sent = drive(5)
    with (
        ros2dds.bridge(mode="router", listen=where) as bridge,
        open_session(ZenohOptions(connect=(where,), config_file=LONG_LEASE), mode="client") as own,
        recording(own, log_path, new_bridge()) as running,
    ):
        announce_all(bridge)
        send_all(bridge, sent)
        running.wait_until(lambda r: r.messages >= len(sent))
    assert [e.payload for e in envelopes(read_log(log_path))] == expected_envelopes(sent)


def test_messages_wait_for_a_late_token_in_their_order(
    log_path: Path, endpoint: str, connected: Sessions
) -> None:
    sent = drive(8)
    with (
        ros2dds.bridge(endpoint) as bridge,
        recording(connected(), log_path, new_bridge()) as running,
    ):
        for topic in KINDS:
            bridge.advertise(topic)
        for topic in ("/tf", "/tf_static", "/map", "/embeddings"):
            bridge.announce(topic, KINDS[topic])
        payloads = send_all(bridge, sent)
        running.wait_until(lambda r: r.held == 8 and r.messages == len(sent) - 8)
        bridge.announce("/detections", BOXES)
        running.wait_until(lambda r: r.messages == len(sent) and r.held == 0)
    events = read_log(log_path)
    of_topic = [e.payload for e in verbatim(events) if e.key == "/detections"]
    assert of_topic == [p for t, p in payloads if t == "/detections"]
    assert len(envelopes(events)) == 8
    check_derived(log_path)


def test_messages_of_no_known_type_are_kept_and_make_nothing(
    log_path: Path, endpoint: str, connected: Sessions
) -> None:
    with (
        ros2dds.bridge(endpoint) as bridge,
        recording(connected(), log_path, new_bridge(topic=["/odd", "/own"])) as running,
    ):
        announce_all(bridge)
        bridge.advertise("/odd")
        bridge.advertise("/own")
        bridge.announce("/own", "robot_msgs/msg/Own")
        for topic in ("/odd", "/own"):
            wait_for_recorder(bridge, topic)
            bridge.send_raw(topic, b"\x00\x01\x00\x00" + topic.encode())
        running.wait_until(lambda r: r.held == 1 and r.messages == 1)
    report = running.finish()
    assert (report.messages, report.untyped, report.clean) == (2, 1, False)
    formats = {e.key: e.format for e in verbatim(read_log(log_path))}
    own = MessageFormat("cdr", "robot_msgs/msg/Own")
    assert formats == {"/odd": MessageFormat("cdr"), "/own": own}


def test_topics_of_other_types_make_nothing_and_are_counted() -> None:
    """Also of a type without a definition, such as a detector's own messages."""
    bridge = new_bridge()
    told = {"detections": "yolo_msgs§msg§DetectionArray", "map": "std_msgs§msg§String"}
    for key, type_name in told.items():
        bridge.note_token(f"@/1/@ros2_lv/MP/{key}/{type_name}/:::")
    text = TYPES.encode(TYPES.make("std_msgs/msg/String", data="x"), "std_msgs/msg/String")
    batch = [BridgedMessage(key, text) for key in (*told, *told)]
    taken = bridge.take(batch, START, lambda _: iter(()))
    assert [each.key for each in taken] == ["/detections", "/map"] * 2
    derivation = bridge.derivation
    assert derivation.refused == {"/detections": 2, "/map": 2}
    assert (
        derivation.reasons["/detections"] == "yolo_msgs/msg/DetectionArray: no such type is known"
    )
    assert (
        bridge.derivation.reasons["/map"]
        == "it is std_msgs/msg/String, not nav_msgs/msg/OccupancyGrid"
    )


def test_broken_messages_are_kept_counted_and_harm_no_other(
    log_path: Path, endpoint: str, connected: Sessions
) -> None:
    sent = drive(6)
    whole = TYPES.encode(sent[3][1], BOXES)
    huge = whole[:20] + b"\xff\xff\xff\x7f" + whole[24:]
    nowhere = detection([("cup", math.nan)], box(1.0, 1.0, 1.0, 1.0))
    broken = [b"", b"\x00", whole[:-7], huge, b"\xff" * 40, b"not cdr", whole[:4], b"{}"]
    with (
        ros2dds.bridge(endpoint) as bridge,
        recording(connected(), log_path, new_bridge()) as running,
    ):
        announce_all(bridge)
        send_all(bridge, sent[:2])
        for payload in broken:
            bridge.send_raw("/detections", payload)
            bridge.send_raw("/tf", payload)
            bridge.send_raw("/map", payload)
        bridge.send("/detections", detections(START + 1, "optical", nowhere))
        send_all(bridge, sent[2:])
        running.wait_until(lambda r: r.messages == len(sent) + 3 * len(broken) + 1)
    report = running.finish()
    unread = {topic: count for topic, count, _ in report.unread}
    assert unread["/detections"] == unread["/map"] == len(broken)
    assert report.rejected == 1  # NaN, by the door of the log, with its reason
    events = read_log(log_path)
    assert [e.payload for e in verbatim(events) if e.key == "/map"][1:] == broken
    (rejected,) = (json.loads(e.payload) for e in events if e.key == REJECTED_KEY)
    assert "confidence" in rejected["reason"]
    ids = [json.loads(e.payload)["keyframe_id"] for e in envelopes(events)]
    assert len(ids) == 6
    assert ids == sorted(ids)
    assert verify_log(log_path).findings == ()
