"""`mapfold ros`: the node's tokens, and what late and early subscribers get of the map, by Zenoh's
own advanced subscriber, which is that of rmw_zenoh."""

import contextlib
import itertools
import json
import math
import os
import queue
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from zenoh.ext import HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.log import NEVER, LogWriter
from eventsrc.record.append import append_payload
from eventsrc.record.recorder.bridged import Bridge
from eventsrc.record.recorder.listener import Heard, Listener
from eventsrc.record.ros_node import TRIGGER, TRIGGER_HASH, TRIGGERED, RosNode
from eventsrc.record.transport.session import Session
from eventsrc.ros.derivation import RosRecording
from eventsrc.ros.stream import Stream
from eventsrc.ros.wire import RmwWire, end_of_key
from projections.adapters.ros.initial_pose import InitialPose
from projections.adapters.ros.map_messages import (
    DETECTIONS,
    GRID,
    MARKERS,
    POSE,
    POSE_WITH_COVARIANCE,
    MapMessages,
    ShownMap,
)
from projections.fold.map_errors import QuestionError
from projections.surfaces.python.map import fold
from tests.support import rmw
from tests.support import ros2dds as drives
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_zenoh import DEADLINE_S, MAPFOLD, Program
from tests.support.logs import simulated
from tests.support.lost_robot import check_initial_pose, look_around
from tests.support.ros_messages import START, TYPES, detections, flat, tf, transform

Sessions = Callable[[], Session]
SAMPLE = "logs/sample"
KINDS = {"markers": MARKERS, "objects": DETECTIONS, "walls": GRID}


def key_of(topic: str) -> str:
    kind = KINDS[topic]
    return f"3/bot1/mapfold/{topic}/{rmw.dds_type(kind)}/{rmw.type_hash(kind)}"


@contextmanager
def subscribed(session: Session, topic: str) -> Iterator["queue.Queue[tuple[Any, bytes]]"]:
    """The messages of a topic as a transient-local subscriber gets them, with attachments."""
    got: queue.Queue[tuple[Any, bytes]] = queue.Queue()

    def receive(sample: zenoh.Sample) -> None:
        attached = sample.attachment
        assert attached is not None
        got.put((TYPES.decode(sample.payload.to_bytes(), KINDS[topic]), attached.to_bytes()))

    subscriber = declare_advanced_subscriber(
        session.raw,
        key_of(topic),
        receive,
        history=HistoryConfig(detect_late_publishers=True, max_samples=5),
        recovery=RecoveryConfig(heartbeat=True),
    )
    yield got
    subscriber.undeclare()


def keys_of(message: Any) -> set[tuple[str, int]]:
    return {(each.ns, each.id) for each in message.markers}


def test_the_graph_has_its_tokens(connected: Sessions) -> None:
    asking = connected()
    with RosNode(connected(), TYPES, 3, "/bot1", "mapfold") as node:
        shown = ShownMap(node)
        node.session.confirm()
        zid, wire = node.session.id, RmwWire(3)
        tokens = asking.tokens("@ros2_lv/3/**", timeout_s=DEADLINE_S)
        assert f"@ros2_lv/3/{zid}/0/0/NN/%mapfold/%bot1/mapfold" in tokens
        found = [each for t in tokens if (each := wire.read_token(t)) is not None]
        assert sorted(each.topic for each in found) == sorted(shown.topics)
        assert all(each.is_latched for each in found)
    node.session.confirm()
    assert asking.tokens("@ros2_lv/3/**", timeout_s=DEADLINE_S) == []


def test_early_subscribers_get_the_changes_and_late_ones_everything(connected: Sessions) -> None:
    before, after = fold(SAMPLE, at=300).view, fold(SAMPLE, preset="rooms").view
    messages = MapMessages(TYPES)
    first, second = messages.markers(before), messages.markers(after)
    changed = messages.changed(first, second)
    deleted = {(each.ns, each.id) for each in changed if each.action == 2}
    assert deleted == first.keys() - second.keys() != set()
    assert len(changed) - len(deleted) > 0
    assert messages.changed(second, messages.markers(after)) == []
    with (
        subscribed(connected(), "markers") as early,
        RosNode(connected(), TYPES, 3, "/bot1", "mapfold") as node,
    ):
        shown = ShownMap(node)
        assert shown.show(before) == len(first)
        whole, attached = early.get(timeout=DEADLINE_S)
        assert keys_of(whole) == first.keys()
        assert RmwWire(3).read_attachment(attached) is not None
        assert shown.show(after) == len(changed)
        told = early.get(timeout=DEADLINE_S)[0]
        while keys_of(told) in (first.keys(), second.keys()):  # kept, as the publisher was detected
            told = early.get(timeout=DEADLINE_S)[0]
        assert keys_of(told) == {(each.ns, each.id) for each in changed}
        assert shown.show(after) == 0
        with subscribed(connected(), "markers") as late, subscribed(connected(), "objects") as seen:
            assert keys_of(late.get(timeout=DEADLINE_S)[0]) == second.keys()
            detections = seen.get(timeout=DEADLINE_S)[0].detections
    confirmed = [each for each in after.objects.values() if each.confirmed]
    shown_ids = [each.object_id for each in confirmed if each.missing_in is None]
    assert [each.id for each in detections] == shown_ids
    at = detections[0].bbox.center.position
    assert (at.x, at.y) == confirmed[0].spot


def test_a_trigger_is_answered(connected: Sessions) -> None:
    answers = iter([(True, "found"), (False, "not yet")])
    with RosNode(connected(), TYPES, 3, "", "mapfold") as node:
        node.trigger("~/localize", lambda: next(answers))
        asking = connected()
        node.session.confirm()
        key = f"3/mapfold/localize/{end_of_key(TRIGGER, TRIGGER_HASH)}"
        request = rmw.attachment(5, bytes(range(16)))
        for expected in ((True, "found"), (False, "not yet")):
            (reply,) = asking.raw.get(key, payload=b"\0\1\0\0\0", attachment=request)
            assert reply.ok is not None
            assert reply.ok.attachment is not None
            assert RmwWire().read_attachment(reply.ok.attachment.to_bytes()) == (
                bytes(range(16)).hex(),
                5,
            )
            made = TYPES.decode(reply.ok.payload.to_bytes(), TRIGGERED)
            assert (made.success, made.message) == expected
        for wrong in (None, bytes(16), bytes(5_000)):
            (reply,) = asking.raw.get(key, attachment=wrong)
            assert reply.err is not None


def test_a_transform_that_is_none_hides_no_other_of_its_message(
    endpoint: str, connected: Sessions
) -> None:
    seen = Stream("/detections", "lost", tf=None, wait_ns=0)
    recording = RosRecording(key="lost", streams=(seen,))
    bridge = Bridge(recording, ["/detections", "/tf_static"], TYPES, RmwWire(3))
    nowhere = transform("base_link", "lidar", 0, flat(math.nan, 0.0, 0.0))
    with rmw.node(endpoint, 3) as robot:
        for topic in ("/tf_static", "/detections"):
            robot.advertise(topic, drives.KINDS[topic])
        robot.send("/tf_static", tf(nowhere, *drives.static().transforms))
        with Listener(connected(), bridge, TYPES) as listener:
            heard: list[Heard] = []
            for number in itertools.count():
                robot.send("/detections", detections(START + number, "optical"))
                heard += listener.take(0.1)
                if heard and heard[-1].camera != (0.0, 0.0):
                    break
    assert heard[-1].camera == (0.2, 0.0)


@pytest.mark.parametrize("most", [3, 200])
def test_of_a_flood_of_keyframes_no_more_are_judged_than_it_takes(
    connected: Sessions, most: int
) -> None:
    read = map(ingest, simulated(7, "b").payloads)
    made = next(e for e in read if isinstance(e, Accepted) and e.envelope.detections)
    flood = contextlib.nullcontext(Flood([Heard(made, (0.0, 0.0))] * 1_000))
    asked, notes, stop = [], list[str](), threading.Event()

    def note(text: str) -> None:
        notes.append(text)
        if "gave up" in text:
            stop.set()

    def ask(question: Any) -> Any:
        asked.append(question)
        if len(asked) == most:
            stop.set()
        raise QuestionError("not now" if len(asked) > 1 else "not yet")

    with RosNode(connected(), TYPES, 3, "", "mapfold") as node:
        pose = InitialPose(node, lambda: flood, ask, note)
        pose.start()
        pose.run(stop)
    assert len(asked) == most
    assert notes == [
        "a question could not be answered: not yet",
        "a question could not be answered: not now",
        f"after {most} keyframes it is not sure where the robot is; gave up",
        "left out 5 messages, which came faster than they could be read",
    ]


class Flood:
    """Keyframes, faster than they are judged, and messages than they are read."""

    lost = 5

    def __init__(self, heard: list[Heard]) -> None:
        self._heard = heard

    def take(self, _timeout_s: float) -> list[Heard]:
        return self._heard


@pytest.mark.seconds
def test_the_command_shows_the_map_and_its_walls(
    endpoint: str, connected: Sessions, start_code: Callable[..., Program]
) -> None:
    program = start_code(
        MAPFOLD, "ros", str(Path(SAMPLE).resolve()), "--connect", endpoint, "--domain", "3",
        "--namespace", "/bot1", "--no-cache",
    )  # fmt: skip
    program.wait_for("node /bot1/mapfold in domain 3")
    assert "marker" in program.wait_for("map of 447 events")
    view = fold(SAMPLE).view
    with subscribed(connected(), "walls") as walls:
        grid = walls.get(timeout=DEADLINE_S)[0]
    assert view.map is not None
    assert (grid.info.width, grid.info.height) == (view.map.map.width, view.map.map.height)
    assert set(grid.data.tolist()) <= {-1, *range(101)}
    assert program.end(signal.SIGINT) == 0


@pytest.mark.seconds
@pytest.mark.parametrize(
    ("size", "said"),
    [
        (0, "it ends before the segment's metadata; run `mapfold log recover"),
        (3_000, "has 0 events that can be read now and had 20; run `mapfold log recover"),
    ],
)
@pytest.mark.slow
def test_a_growing_log_that_is_cut_off_beneath_the_command_ends_it(
    tmp_path: Path, endpoint: str, start_code: Callable[..., Program], size: int, said: str
) -> None:
    log = tmp_path / "log"
    with LogWriter(tmp_path / "growing", fsync=NEVER) as writer:
        for number in range(20):
            append_payload(writer, "tb/x", payload(envelope(number)), logged_ns=number + 1)
        writer.sync()
        shutil.copytree(writer.path, log)
    program = start_code(MAPFOLD, "ros", str(log), "--connect", endpoint, "--no-cache")
    program.wait_for("map of 20 events")
    (growing,) = log.glob("*.active")
    os.truncate(growing, size)
    program.wait_for(said)
    assert program.process.wait(DEADLINE_S) == 1


def test_options_of_the_command(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    for wrong, said in (
        ([], "give a LOG, or --db"),
        (["L", "--name", "a b"], "is no name of a ROS 2 node"),
        (["L", "--namespace", "/a b"], "is no ROS 2 namespace"),
        (["L", "--vector-db", "x"], "--vector-db is for --db"),
    ):
        assert said in run("ros", *wrong, code=2).err


@pytest.mark.seconds
def test_a_lost_robot_that_looks_around_is_told_where_it_is(
    endpoint: str, connected: Sessions, start_code: Callable[..., Program]
) -> None:
    end = end_of_key(POSE_WITH_COVARIANCE, rmw.type_hash(POSE_WITH_COVARIANCE))
    told: queue.Queue[Any] = queue.Queue()
    session = connected()
    session.subscribe(
        f"3/initialpose/{end}", lambda m: told.put(TYPES.decode(m.payload, POSE_WITH_COVARIANCE))
    )
    session.confirm()
    program = start_code(
        MAPFOLD, "ros", str(Path(SAMPLE).resolve()), "--connect", endpoint, "--domain", "3",
        "--no-cache",
    )  # fmt: skip
    program.wait_for("map of 447 events")
    trigger = f"3/mapfold/localize/{end_of_key(TRIGGER, TRIGGER_HASH)}"
    asked = rmw.attachment(1, bytes(16))
    (reply,) = session.raw.get(trigger, payload=b"\0\1\0\0\0", attachment=asked)
    assert reply.ok is not None
    assert b"turn the robot" in reply.ok.payload.to_bytes()
    program.wait_for("waiting for a publisher of vision_msgs/msg/Detection2DArray")
    poses: list[Any] = []

    def is_told() -> bool:
        with contextlib.suppress(queue.Empty):
            poses.append(told.get(timeout=0.1))
        return bool(poses)

    with rmw.node(endpoint, 3) as robot:
        sent = look_around(robot, is_told)
    check_initial_pose(poses[0], sent)
    program.wait_for("/initialpose: (")
    assert program.end(signal.SIGINT) == 0


def test_a_goal_is_sent(tmp_path: Path, endpoint: str, connected: Sessions) -> None:
    run = Commands.in_folder(tmp_path)
    goal = "find", str(Path(SAMPLE).resolve()), "toilet", "--goal", "json", "--no-cache"
    at = "--connect", endpoint, "--domain", "3", "--namespace", "/bot1"
    assert "give --goal" in run("find", goal[1], "--send", code=2).err
    assert "go with --send" in run(*goal, "--domain", "3", code=2).err
    told: queue.Queue[Any] = queue.Queue()
    session = connected()
    key = f"3/bot1/goal_pose/{end_of_key(POSE, rmw.type_hash(POSE))}"
    with session.raw.declare_subscriber(
        key, lambda sample: told.put(TYPES.decode(sample.payload.to_bytes(), POSE))
    ):
        session.confirm()
        sent = run(*goal, "--send", *at)
        assert "sent to /bot1/goal_pose" in sent.err
        message = told.get(timeout=DEADLINE_S)
    printed = json.loads(sent.out)
    position = message.pose.position
    assert message.header.frame_id == "map"
    assert (position.x, position.y) == (printed["x"], printed["y"])
    yaw = 2 * math.atan2(message.pose.orientation.z, message.pose.orientation.w)
    assert math.isclose(yaw, printed["yaw"], abs_tol=1e-9)
