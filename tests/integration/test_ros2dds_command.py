"""`mapfold record --ros2dds` as a command; keys, tokens and counts of messages of a bridge."""

import json
import signal
import threading
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.log import follow
from eventsrc.record.recorder.bridged import HOLD_MESSAGES
from eventsrc.record.recorder.queue import BridgedMessage, MessageQueue
from eventsrc.record.transport.session import Session
from eventsrc.ros.wire import BridgeWire, topic_of
from projections.surfaces.cli.bridge_options import recording_of
from tests.support import ros2dds
from tests.support.commands import Commands
from tests.support.fixtures_log import read_log
from tests.support.fixtures_zenoh import DEADLINE_S, MAPFOLD, Program
from tests.support.ros2dds import TF, drive
from tests.support.ros2dds_recordings import (
    announce_all,
    choice,
    new_bridge,
    recording,
    send_all,
    wait_for_recorder,
)
from tests.support.ros_messages import (
    SECOND,
    START,
    TYPES,
)
from tests.support.thorough import every_other

Sessions = Callable[[], Session]


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
        ("@/f0/@ros2_lv/MP/tf/tf2_msgs§msg§TFMessage/:1:0:0,10", ("/tf", TF)),
        ("@/f0/@ros2_lv/MP/bot1§tf/tf2_msgs§msg§TFMessage/K:::", ("/bot1/tf", TF)),
        ("@ros2_lv/f0/MP/bot1§tf/tf2_msgs§msg§TFMessage/:::", ("/bot1/tf", TF)),
        ("@/f0/@ros2_lv/MP/tf/tf2_msgs§msg§TFMessage", ("/tf", TF)),
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
    read = BridgeWire().read_token(token)
    assert (None if read is None else read[:2]) == found


def test_tokens_are_found_by_their_selectors() -> None:
    for token in (
        "@/f0/@ros2_lv/MP/bot1§tf/tf2_msgs§msg§TFMessage/:1:0:0,10",
        "@ros2_lv/f0/MP/bot1§tf/tf2_msgs§msg§TFMessage/:::",
    ):
        selectors = BridgeWire().token_selectors("/bot1/tf")
        assert sum(zenoh.KeyExpr(s).intersects(zenoh.KeyExpr(token)) for s in selectors) == 1


@pytest.mark.parametrize(
    "topic", ["", "/", "a b", "/tf/*", "/tf$*", "/x?y", "//tf", "/1a", "ä", "a/"]
)
def test_what_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(MisuseError, match="no name of a ROS 2 topic"):
        topic_of("", topic, "--detections")
    with pytest.raises(MisuseError, match="no ROS 2 namespace"):
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
    assert "go with --ros2 or --ros2dds" in said.err
    said = run("record", "L", "--ros2dds", "--topic", "/a b", code=2)
    assert "is no name of a ROS 2 topic" in said.err
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


@pytest.mark.seconds
def test_keyframes_of_a_run_that_goes_on_after_a_kill_have_numbers_of_their_own(
    tmp_path: Path, endpoint: str, start_code: Callable[..., Program]
) -> None:
    """Those that waited for a pose when the recorder was killed are made first, and count."""
    log, sent = tmp_path / "log", drive(4)
    with ros2dds.bridge(endpoint) as bridge:
        announce_all(bridge)
        for killed in (True, False):
            program = start_code(
                MAPFOLD, "record", str(log), "--connect", endpoint, "--ros2dds",
                "--embeddings", "/embeddings", "--run-id", "r",
            )  # fmt: skip
            program.wait_for("Ctrl-C ends it")
            send_all(bridge, sent[:-1] if killed else sent)  # without the last pose
            last = "/embeddings" if killed else "/tf"
            seen = 0
            for event in follow(log, FIRST_OFFSET, stop=threading.Event()):
                seen += event is not None and event.key == last
                if seen == (4 if killed else 15):
                    break
            assert program.end(signal.SIGKILL if killed else signal.SIGINT) == -9 * killed
    envelopes = [json.loads(e.payload) for e in read_log(log) if e.is_envelope]
    assert [each["keyframe_id"] for each in envelopes] == [*range(8)]
