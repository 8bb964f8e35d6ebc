"""Recording what a zenoh-bridge-ros2dds sends, over real sessions: messages verbatim, envelopes of
them right behind, whatever comes late, twice, broken or not at all."""

import json
import math
import signal
import socket
import threading
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from eventsrc.envelope import FIRST_OFFSET
from eventsrc.errors import LogDamaged, MisuseError
from eventsrc.gap_history import ledger_of
from eventsrc.importers import import_files
from eventsrc.importers.bag_streams import BagOptions
from eventsrc.log import (
    Event,
    LogReader,
    LogWriter,
    MessageFormat,
    NewEvent,
    VerbatimEvent,
    follow,
    verify_log,
)
from eventsrc.recorder import Recorder
from eventsrc.recorder.bridged import HOLD_MESSAGES, Bridge
from eventsrc.recorder.checking import Checker
from eventsrc.recorder.queue import BridgedMessage, MessageQueue
from eventsrc.recorder.unfinished import append_missing, message_of
from eventsrc.ros.assembler import Assembled, Assembler, RosMessage
from eventsrc.ros.bridge_keys import token_selectors, topic_of, type_of_token
from eventsrc.ros.derivation import RosRecording, derive, read_recording
from eventsrc.system_events import LOSS_KEY, MAP_KEY, REJECTED_KEY, ROS_KEY, Loss
from eventsrc.transport.session import Session, ZenohOptions, open_session
from projections.cli.bridged import NOTHING, recording_of
from projections.model.digest import map_digest
from projections.model.fold import fold_log
from projections.settings import Settings
from tests import ros2dds
from tests.commands import Commands
from tests.fixtures_log import KEY, read_log
from tests.fixtures_zenoh import DEADLINE_S, LONG_LEASE, MAPFOLD, Program
from tests.recorders import Running
from tests.ros2dds_drive import BOXES, KINDS, LATCHED, TF, Sent, drive
from tests.ros_bags import write_bag
from tests.ros_messages import (
    SECOND,
    START,
    TYPES,
    box,
    detection,
    detections,
)
from tests.thorough import every_other

Sessions = Callable[[], Session]


def choice(namespace: str = "", **more: Any) -> Any:
    return NOTHING._replace(namespace=namespace, embeddings="/embeddings", run_id="drive", **more)


def new_bridge(namespace: str = "", **more: Any) -> Bridge:
    recording, topics = recording_of(choice(namespace, **more), 0, None)
    return Bridge(recording, topics, TYPES)


@contextmanager
def recording(
    session: Session, log: Path, bridge: Bridge, queue_size: int = 10_000, **more: Any
) -> Iterator[Running]:
    with LogWriter(log) as writer:
        with LogReader(log) as reader:
            ledger = ledger_of(reader)
        recorder = Recorder(
            session, writer, (), queue_size=queue_size, ledger=ledger, bridge=bridge, **more
        )
        running = Running(recorder)
        try:
            yield running
        finally:
            running.finish()


def wait_for_recorder(bridge: ros2dds.Bridge, topic: str) -> None:
    """Until the bridge's session knows of a subscriber to a topic."""
    matched = threading.Event()
    publisher = bridge.session.declare_publisher(bridge.key(topic))
    listener = publisher.declare_matching_listener(
        lambda status: matched.set() if status.matching else None
    )
    assert publisher.matching_status.matching or matched.wait(DEADLINE_S)
    listener.undeclare()
    publisher.undeclare()


def send_all(bridge: ros2dds.Bridge, sent: Sent) -> list[tuple[str, bytes]]:
    """Send messages; returns topic and CDR of each."""
    for topic in dict.fromkeys(topic for topic, _ in sent):
        wait_for_recorder(bridge, topic)
    return [(topic, bridge.send(topic, message)) for topic, message in sent]


def announce_all(bridge: ros2dds.Bridge) -> None:
    for topic, type_name in KINDS.items():
        bridge.advertise(topic, latched=topic in LATCHED)
        bridge.announce(topic, type_name, latched=topic in LATCHED)


def expected_envelopes(sent: Sent, namespace: str = "") -> list[bytes]:
    """What the assembler makes of the messages themselves, without CDR, log or Zenoh."""
    ros_recording, _ = recording_of(choice(namespace), 0, None)
    assembler: Assembler[None] = Assembler(ros_recording.streams)
    made: list[Assembled | None] = []
    for topic, message in sent:
        if topic != "/map":
            name = topic_of(namespace, topic, "")
            made += assembler.add(RosMessage(name, KINDS[topic], START, message))
    return [each.payload for each in [*made, *assembler.finish()] if each is not None]


def verbatim(events: list[Event]) -> list[VerbatimEvent]:
    return [event for event in events if isinstance(event, VerbatimEvent)]


def envelopes(events: list[Event]) -> list[Event]:
    return [event for event in events if event.is_envelope]


def digest(log: Path) -> str:
    with LogReader(log) as reader:
        return map_digest(fold_log(reader, Settings())[1])


def check_derived(log: Path) -> None:
    """Every envelope and map stands right behind the message that completes it, or at the end, and
    is made again of the messages alone."""
    events = read_log(log)
    made = list(derive(events, TYPES, message_of))
    recorded = [event for event in events if event.is_envelope or event.key == MAP_KEY]
    assert [each.derived.payload for each in made] == [event.payload for event in recorded]
    for (completed_at, _), event in zip(made, recorded, strict=True):
        between = events[(completed_at or 0) + 1 : event.offset]
        if completed_at is not None:
            assert all(each in recorded for each in between)
        else:
            assert event.offset > max(each.offset for each in verbatim(events))


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
        running.wait_until(lambda _: len(own.types_told) == len(KINDS))
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


def test_the_map_is_that_of_the_envelopes_alone(
    log_path: Path, tmp_path: Path, endpoint: str, connected: Sessions
) -> None:
    sent = drive(30)
    with (
        ros2dds.bridge(endpoint) as bridge,
        recording(connected(), log_path, new_bridge()) as running,
    ):
        announce_all(bridge)
        send_all(bridge, sent)
        running.wait_until(lambda r: r.messages >= len(sent))
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
    sent = drive(25)
    with (
        ros2dds.bridge(endpoint) as bridge,
        recording(connected(), log_path, new_bridge()) as running,
    ):
        announce_all(bridge)
        send_all(bridge, sent)
        running.wait_until(lambda r: r.messages >= len(sent))
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
        recording(connected(), log_path, new_bridge(topics=["/odd", "/own"])) as running,
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
    assert bridge.refused == {"/detections": 2, "/map": 2}
    assert bridge.reasons["/detections"] == "yolo_msgs/msg/DetectionArray: no such type is known"
    assert bridge.reasons["/map"] == "it is std_msgs/msg/String, not nav_msgs/msg/OccupancyGrid"


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


def test_every_message_of_a_flood_is_recorded_or_counted(
    log_path: Path, endpoint: str, connected: Sessions
) -> None:
    count = 6_000
    payload = TYPES.encode(drive(1)[2][1], TF)
    with (
        ros2dds.bridge(endpoint, old=True) as bridge,
        recording(connected(), log_path, new_bridge(), queue_size=20) as running,
    ):
        announce_all(bridge)
        wait_for_recorder(bridge, "/tf")
        for _ in range(count):
            bridge.send_raw("/tf", payload)
        running.wait_until(lambda r: r.messages + r.queue_full >= count)
    report = running.finish()
    assert report.messages + report.queue_full == count
    lost = [json.loads(e.payload) for e in read_log(log_path) if e.key == "mapfold/loss"]
    assert sum(each["count"] for each in lost) == report.queue_full


@pytest.mark.seconds
def test_a_killed_recording_is_completed_by_the_next(tmp_path: Path) -> None:
    """The log ends at any event, as after a kill: what the messages before it make is added."""
    ros_recording, _ = recording_of(choice(), 0, None)
    whole = tmp_path / "whole"
    with LogWriter(whole) as writer:
        bridge = new_bridge()
        for topic, type_name in KINDS.items():
            bridge.note_token(f"@/1/@ros2_lv/MP/{topic[1:]}/{type_name.replace('/', '§')}/:::")
        checker = Checker(MessageQueue(), writer, max_payload_bytes=10**7, max_messages=None)
        writer.append(ROS_KEY, ros_recording.encode())
        for number, (topic, message) in enumerate(drive(4)):
            cdr = BridgedMessage(topic[1:], TYPES.encode(message, KINDS[topic]))
            logged = START + number
            taken = bridge.take([cdr], logged, checker.check)
            writer.append_all([each.event(logged) for each in taken])
    events = read_log(whole)
    assert len(envelopes(events)) == 4
    for end in range(1, len(events) + 1):
        log = tmp_path / f"killed-{end}"
        with LogWriter(log) as writer:
            for event in events[:end]:
                form = event.format if isinstance(event, VerbatimEvent) else None
                times = event.logged_ns, event.stamp_ns
                writer.append_all([NewEvent(event.key, event.payload, *times, format=form)])
            writer.sync()
            with LogReader(log) as reader:
                made = append_missing(reader, writer, TYPES)
                reader.refresh()
                assert append_missing(reader, writer, TYPES) == 0
        after = read_log(log)
        pictures = [e for e in verbatim(after) if e.key == "/detections"]
        assert len(envelopes(after)) == len(pictures)
        grids = sum(e.key == "/map" for e in after)
        assert sum(e.key == MAP_KEY for e in after) == grids
        assert made == len(after) - end - 1
        ready = [d.payload for _, d in derive(events[:end], TYPES, message_of)]
        assert sorted(ready) == sorted(
            e.payload for e in after if e.is_envelope or e.key == MAP_KEY
        )


def test_a_damaged_recording_is_not_completed(tmp_path: Path) -> None:
    how, _ = recording_of(choice(), 0, None)
    form = MessageFormat("cdr", BOXES, "ros2msg", TYPES.definition(BOXES).encode())
    picture = TYPES.encode(drive(1)[3][1], BOXES)
    loss = Loss(publisher="log", first=1, last=1, count=1, cause="rot").model_dump_json().encode()
    for lost, made in ((False, 1), (True, 0)):
        with LogWriter(tmp_path / f"log-{lost}") as writer:
            writer.append(ROS_KEY, how.encode())
            if lost:
                writer.append(LOSS_KEY, loss)
            writer.append("/detections", picture, form=form)
            writer.sync()
            with LogReader(writer.path) as reader:
                assert append_missing(reader, writer, TYPES) == made
                writer.append(ROS_KEY, b"{}")
                writer.sync()
                reader.refresh()
                with pytest.raises(LogDamaged, match="cannot be read"):
                    append_missing(reader, writer, TYPES)


def test_a_run_that_goes_on_counts_on(log_path: Path, endpoint: str, connected: Sessions) -> None:
    session = connected()
    for start in (0, 3):
        with ros2dds.bridge(endpoint) as bridge, LogWriter(log_path) as writer:
            with LogReader(log_path) as reader:
                ledger = ledger_of(reader)
            how, topics = recording_of(choice(), 0, ledger)
            assert how.streams[0].first_keyframe == start
            own = Bridge(how, topics, TYPES)
            running = Running(Recorder(session, writer, (), ledger=ledger, bridge=own))
            announce_all(bridge)
            sent = drive(3)
            send_all(bridge, sent)
            running.wait_until(lambda r: r.messages >= 14)
            assert len(sent) == 14
            assert running.finish().missing == 0
    ids = [json.loads(e.payload)["keyframe_id"] for e in envelopes(read_log(log_path))]
    assert ids == [0, 1, 2, 3, 4, 5]
    check_derived(log_path)


def test_held_messages_are_bounded() -> None:
    bridge = new_bridge()
    taken = []
    for number in range(0, HOLD_MESSAGES + 500, 100):
        batch = [BridgedMessage("tf", b"%06d" % n) for n in range(number, number + 100)]
        taken += bridge.take(batch, START, lambda _: iter(()))
    assert bridge.held == HOLD_MESSAGES
    assert [each.payload for each in taken] == [b"%06d" % n for n in range(len(taken))]
    taken += bridge.take((), START + 11 * SECOND, lambda _: iter(()))
    assert bridge.held == 0
    taken += bridge.take([BridgedMessage("tf", b"x")], START, lambda _: iter(()))
    bridge.note_token("@/1/@ros2_lv/MP/tf/tf2_msgs§msg§TFMessage/:::")
    taken += bridge.finish(START, lambda _: iter(()))
    assert [each.payload for each in taken[-2:]] == [b"%06d" % (HOLD_MESSAGES + 503), b"x"]
    assert bridge.untyped == HOLD_MESSAGES + 504


@pytest.mark.parametrize(
    ("token", "found"),
    [
        ("@/f0/@ros2_lv/MP/tf/tf2_msgs§msg§TFMessage/:1:0:0,10", ("tf", TF)),
        ("@/f0/@ros2_lv/MP/bot1§tf/tf2_msgs§msg§TFMessage/K:::", ("bot1/tf", TF)),
        ("@ros2_lv/f0/MP/bot1§tf/tf2_msgs§msg§TFMessage/:::", ("bot1/tf", TF)),
        ("@/f0/@ros2_lv/MP/tf/tf2_msgs§msg§TFMessage", ("tf", TF)),
        ("@/f0/@ros2_lv/MS/tf/tf2_msgs§msg§TFMessage/:::", None),
        ("@/f0/@ros2_lv/MP/tf/TFMessage/:::", None),
        ("@/f0/@ros2_lv/MP/tf/a§srv§B/:::", None),
        ("@/f0/@ros2_lv/MP/tf/a§msg§../:::", None),
        (f"@/f0/@ros2_lv/MP/tf/a§msg§{'B' * 200}/:::", None),
        (f"@/f0/@ros2_lv/MP/tf/a§msg§B/{'1' * 5000}", None),
        ("@ros2_lv/0/f0/0/11/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/h/q", None),
        ("tf", None),
    ],
)
def test_tokens(token: str, found: tuple[str, str] | None) -> None:
    assert type_of_token(token) == found


def test_tokens_are_found_by_their_selectors() -> None:
    for token in (
        "@/f0/@ros2_lv/MP/bot1§tf/tf2_msgs§msg§TFMessage/:1:0:0,10",
        "@ros2_lv/f0/MP/bot1§tf/tf2_msgs§msg§TFMessage/:::",
    ):
        selectors = token_selectors("bot1/tf")
        assert sum(zenoh.KeyExpr(s).intersects(zenoh.KeyExpr(token)) for s in selectors) == 1


@pytest.mark.parametrize(
    "topic", ["", "/", "a b", "/tf/*", "/tf$*", "/x?y", "//tf", "/1a", "ä", "a/"]
)
def test_what_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(MisuseError, match="no topic of ROS 2"):
        topic_of("", topic, "--detections")
    with pytest.raises(MisuseError, match="no "):
        topic_of("/**", "/tf", "--detections")


def metrics_text(program: Program) -> str:
    """What a recorder's ``/metrics`` gives now."""
    url = program.wait_for("metrics on").split()[-1]
    with urllib.request.urlopen(url, timeout=DEADLINE_S) as answer:
        text: str = answer.read().decode()
    return text


def test_messages_under_keys_of_no_topic_are_counted() -> None:
    """Zenoh lets a publisher use a key expression, which matches the topics that are recorded."""
    bridge = new_bridge()
    batch = [BridgedMessage(key, b"x") for key in ("*", "**", "t*", "detections")]
    assert bridge.take(batch, START, lambda _: iter(())) == []
    assert (bridge.unknown_keys, bridge.held) == (3, 1)


@pytest.mark.seconds
def test_the_command_records_says_so_and_ends_clean(
    tmp_path: Path, endpoint: str, start_code: Callable[..., Program]
) -> None:
    log = tmp_path / "log"
    with ros2dds.bridge(endpoint, namespace="bot1") as bridge:
        announce_all(bridge)
        program = start_code(
            MAPFOLD, "record", str(log), "--connect", endpoint, "--ros2dds", "--namespace",
            "/bot1", "--embeddings", "embeddings", "--run-id", "r", "--json", "--metrics", "0",
        )  # fmt: skip
        program.wait_for("keyframes of r")
        program.wait_for("Ctrl-C ends it")
        sent = drive(10)
        send_all(bridge, sent)
        reader_stop = threading.Event()
        seen = 0
        for event in follow(log, FIRST_OFFSET, stop=reader_stop):
            seen += event is not None and event.is_envelope
            if seen == 10:
                break
        scraped = metrics_text(program)
        assert program.end(signal.SIGINT) == 0
    document = json.loads(program.output())
    assert (document["recorded"], document["messages"]) == (11, len(sent))
    made = document["streams"]["/bot1/detections"]
    assert (made["keyframes"], made["without_camera"], made["without_pose"]) == (10, 10, 0)
    assert made["detections"] == made["with_embedding"] == 10
    assert document["unknown_keys"] == 0
    assert 'mapfold_recorder_ros_keyframes_total{topic="/bot1/detections"} 10.0' in scraped
    assert "mapfold_recorder_ros_unknown_keys_total 0.0" in scraped
    assert any(f"{len(sent)} messages of ROS" in line for line in program.lines)
    counted = "/bot1/detections: 10 keyframes; 10 without the camera's field of view"
    assert any(line.startswith(counted) for line in program.lines), program.lines


def test_options_for_ros_need_ros2dds(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    said = run("record", "L", "--namespace", "/bot1", code=2)
    assert "go with --ros2dds" in said.err
    said = run("record", "L", "--ros2dds", "--topic", "/a b", code=2)
    assert "is no topic of ROS 2" in said.err
    (tmp_path / "labels").write_text("cup\n\nchair\n")
    refused = [["--run-id", "a\nb"], ["--max-gap", "nan"], ["--labels", "no"], ["--pose", "*"]]
    for wrong in every_other(refused):
        assert run("record", "L", "--ros2dds", *wrong, code=2).err.count("\n") == 1
    assert not (tmp_path / "L").exists()
    labels, several = tmp_path / "labels", ["/left/detections", "/right/detections"]
    how, topics = recording_of(
        choice("bot1", labels=labels, heights=True, detections=several), 0, None
    )
    assert [s.run_id for s in how.streams] == ["drive:bot1/left", "drive:bot1/right"]
    assert how.streams[0].labels == {"0": "cup", "2": "chair"}
    assert {"/bot1/left/detections", "/bot1/tf", "/bot1/map", "/bot1/embeddings"} < {*topics}
    how, topics = recording_of(choice(pose="none", grid="none"), 0, None)
    assert topics == ("/detections", "/embeddings")
    assert [(s.pose, s.tf, s.tf_static) for s in how.streams] == [(None, None, None)]


def test_messages_that_find_the_queue_full_are_counted_by_key() -> None:
    queue = MessageQueue(2, max_wait_s=0.0)
    for number in range(5):
        queue.put(BridgedMessage("bot1/tf", b"%d" % number))
    assert [m.payload for m in queue.get(9, 0.0)] == [b"0", b"1"]
    assert queue.drain_overflow() == {"bot1/tf": 3}


def test_an_import_of_the_log_takes_all_over(
    log_path: Path, tmp_path: Path, endpoint: str, connected: Sessions
) -> None:
    with (
        ros2dds.bridge(endpoint) as bridge,
        recording(connected(), log_path, new_bridge()) as running,
    ):
        announce_all(bridge)
        send_all(bridge, drive(5))
        running.wait_until(lambda r: r.messages >= 22)
    with LogWriter(tmp_path / "copy") as writer:
        report = import_files(writer, [str(log_path)])
    assert (report.accepted, report.verbatim, report.rejected) == (5, 22, 0)
    copied, events = read_log(tmp_path / "copy"), read_log(log_path)
    assert [(type(e), e.key, e.payload) for e in copied] == [
        (type(e), e.key, e.payload) for e in events
    ]
    check_derived(tmp_path / "copy")
    with LogWriter(tmp_path / "copy") as writer:
        writer.append(ROS_KEY, b'{"key": 3}')
    (finding,) = verify_log(tmp_path / "copy").findings
    assert finding.kind == "schema"
    assert "mapfold/ros event cannot be read" in finding.message


def test_a_recording_event_is_read_back() -> None:
    how, _ = recording_of(choice("bot1", camera="/camera/camera_info"), 0, None)
    assert read_recording(how.encode()) == how
    assert read_recording(RosRecording(key=KEY).encode()).streams == ()
