"""zenoh-ros2-sdk, a node over rmw_zenoh by somebody else, as the robot in another process: its
keys, tokens, type hashes and attachments, recorded and found by `record --ros2`."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.envelope.system_events import LOSS_KEY
from tests.support.fixtures_log import read_log
from tests.support.fixtures_zenoh import MAPFOLD, Program
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


def test_its_type_hash_is_that_of_rosbags() -> None:
    from zenoh_ros2_sdk.utils import compute_type_hash_from_msg  # skipped where it is not there

    definition = TYPES.definition("std_msgs/msg/String").partition("=" * 80)[0]
    assert compute_type_hash_from_msg("std_msgs/msg/String", definition) == type_hash(
        "std_msgs/msg/String"
    )
