"""zenoh-ros2-sdk, a node over rmw_zenoh by somebody else, as the robot in another process: its
keys, tokens, type hashes and attachments, recorded and found by `record --ros2`."""

import contextlib
import json
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.envelope.system_events import LOSS_KEY
from projections.adapters.ros.map_messages import (
    DETECTIONS,
    GRID,
    MARKERS,
    POSE_WITH_COVARIANCE,
    MapMessages,
)
from projections.surfaces.python.map import fold
from tests.support import rmw
from tests.support.fixtures_log import read_log
from tests.support.fixtures_zenoh import DEADLINE_S, MAPFOLD, Program
from tests.support.logs import SAMPLE
from tests.support.lost_robot import check_initial_pose, look_around
from tests.support.rmw import type_hash
from tests.support.ros2dds import KINDS, drive
from tests.support.ros2dds_recordings import check_derived, envelopes, verbatim
from tests.support.ros_messages import TYPES

pytest.importorskip("zenoh_ros2_sdk")
pytestmark = pytest.mark.slow

KEYFRAMES = 2_500
ROBOT = """
import sys
import types
import zenoh

if sys.argv[3] == "block":  # where it looks for the setting; there is no such module any more
    zenoh.qos = types.SimpleNamespace(CongestionControl=zenoh.CongestionControl)
from zenoh_ros2_sdk import ROS2Publisher
from tests.support.rmw import type_hash
from tests.support.ros2dds import KINDS, drive
from tests.support.ros_messages import TYPES

port, keyframes = map(int, sys.argv[1:3])
publishers = {
    topic: ROS2Publisher(
        topic=topic, msg_type=kind, msg_definition=TYPES.definition(kind),
        type_hash=type_hash(kind), router_port=port, domain_id=7,
    )
    for topic, kind in KINDS.items()
}

def confirm():
    # A reply comes behind what the router has to say, and the router has what was sent before.
    for _ in publishers["/tf"].session_mgr.session.get("mapfold/confirm/robot"):
        pass

print("ready", flush=True)
sys.stdin.readline()
confirm()
for topic, message in drive(keyframes):
    publishers[topic].publish(**vars(message))
confirm()
print("sent", flush=True)
sys.stdin.readline()
"""


@pytest.mark.parametrize("congestion", ["block", "drop"])
def test_ten_thousand_messages_of_its_node_are_recorded_or_counted_as_lost(
    tmp_path: Path, endpoint: str, start_code: Callable[..., Program], congestion: str
) -> None:
    """It sends as fast as it can. Zenoh drops some messages, as it does of rmw_zenoh's publishers,
    unless they block; each publisher's numbers tell how many."""
    log, sent, port = tmp_path / "log", drive(KEYFRAMES), endpoint.rpartition(":")[2]
    assert len(sent) == 10_002
    with subprocess.Popen(
        [sys.executable, "-c", ROBOT, port, str(KEYFRAMES), congestion],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as robot:
        try:
            assert robot.stdin is not None
            assert robot.stdout is not None
            assert robot.stdout.readline() == "ready\n"
            recorder = start_code(
                MAPFOLD, "record", str(log), "--connect", endpoint, "--ros2",
                "--domain", "7", "--run-id", "drive", "--json",
            )  # fmt: skip
            recorder.wait_for("Ctrl-C ends it")
            robot.stdin.write("go\n")
            robot.stdin.flush()
            assert robot.stdout.readline() == "sent\n"
            ended = recorder.end(signal.SIGINT)
        finally:
            robot.kill()
    events, lost = read_log(log), 0
    for name in KINDS:
        payloads = [TYPES.encode(message, KINDS[topic]) for topic, message in sent if topic == name]
        places = {payload: place for place, payload in enumerate(payloads)}
        kept = [places[event.payload] for event in verbatim(events) if event.key == name]
        assert kept == sorted(set(kept))
        lost += kept[-1] - kept[0] + 1 - len(kept)
    told = [json.loads(event.payload) for event in events if event.key == LOSS_KEY]
    assert sum(loss["count"] for loss in told) == lost
    assert {loss["cause"] for loss in told} <= {"transport_miss"}
    assert ended == (3 if lost else 0)
    assert len(verbatim(events)) > len(sent) / 2
    check_derived(log)
    if congestion == "block":
        assert (lost, len(verbatim(events)), len(envelopes(events))) == (0, len(sent), KEYFRAMES)


LISTENER = """
import json
import sys
from zenoh_ros2_sdk import ROS2Subscriber
from tests.support.rmw import type_hash
from tests.support.ros_messages import TYPES
from projections.adapters.ros.map_messages import MARKERS, POSE_WITH_COVARIANCE

port = int(sys.argv[1])

def told(kind, message):
    text = TYPES.encode(message, kind).hex()
    print(json.dumps({"kind": kind, "cdr": text}), flush=True)

subscribers = [
    ROS2Subscriber(
        topic=topic, msg_type=kind, msg_definition=TYPES.definition(kind), domain_id=7,
        type_hash=type_hash(kind), router_port=port,
        callback=lambda message, kind=kind: told(kind, message),
    )
    for topic, kind in (("/mapfold/markers", MARKERS), ("/initialpose", POSE_WITH_COVARIANCE))
]
session = subscribers[0].session_mgr.session
for _ in session.get("mapfold/confirm/listener"):
    pass
print("ready", flush=True)
sys.stdin.readline()
"""


def test_it_lists_our_topics_and_decodes_our_markers_and_the_initial_pose(
    endpoint: str, start_code: Callable[..., Program]
) -> None:
    port = endpoint.rpartition(":")[2]
    told: queue.Queue[dict[str, str]] = queue.Queue()
    with subprocess.Popen(
        [sys.executable, "-c", LISTENER, port],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as listener:
        try:
            assert listener.stdout is not None
            assert listener.stdout.readline() == "ready\n"
            lines = listener.stdout
            threading.Thread(target=lambda: [told.put(json.loads(line)) for line in lines]).start()
            program = start_code(
                MAPFOLD, "ros", str(SAMPLE), "--connect", endpoint, "--domain", "7", "--auto",
                "--no-cache",
            )  # fmt: skip
            markers = told.get(timeout=DEADLINE_S)
            poses: list[dict[str, str]] = []

            def is_told() -> bool:
                with contextlib.suppress(queue.Empty):
                    message = told.get(timeout=0.1)
                    poses.extend([message] if message["kind"] == POSE_WITH_COVARIANCE else [])
                return bool(poses)

            with rmw.node(endpoint, 7) as robot:
                sent = look_around(robot, is_told)
            listed = subprocess.run(
                [sys.executable, "-m", "zenoh_ros2_sdk.topic_cli", "--router", f"127.0.0.1:{port}",
                 "--domain-id", "7", "list", "-t"],
                capture_output=True, text=True, check=True,
            ).stdout  # fmt: skip
            assert program.end(signal.SIGINT) == 0
        finally:
            listener.kill()
    view = fold(SAMPLE).view
    whole = TYPES.decode(bytes.fromhex(markers["cdr"]), MARKERS)
    assert {(m.ns, m.id) for m in whole.markers} == MapMessages(TYPES).markers(view).keys()
    check_initial_pose(TYPES.decode(bytes.fromhex(poses[0]["cdr"]), POSE_WITH_COVARIANCE), sent)
    for topic, kind in (
        ("/mapfold/markers", MARKERS),
        ("/mapfold/objects", DETECTIONS),
        ("/mapfold/walls", GRID),
        ("/initialpose", POSE_WITH_COVARIANCE),
    ):
        assert f"{topic} [{kind}]" in listed


def test_its_type_hash_is_that_of_rosbags() -> None:
    from zenoh_ros2_sdk.utils import compute_type_hash_from_msg  # skipped where it is not there

    definition = TYPES.definition("std_msgs/msg/String").partition("=" * 80)[0]
    assert compute_type_hash_from_msg("std_msgs/msg/String", definition) == type_hash(
        "std_msgs/msg/String"
    )
