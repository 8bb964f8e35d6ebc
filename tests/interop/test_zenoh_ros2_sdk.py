"""zenoh-ros2-sdk, a node over rmw_zenoh by somebody else, as the robot in another process: its
keys, tokens, type hashes and attachments, recorded and found by `record --ros2`."""

import itertools
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.log import LogWriter, follow
from eventsrc.record.importers.bag_streams import BagOptions
from eventsrc.record.importers.run import import_files
from tests.support.fixtures_log import read_log
from tests.support.fixtures_zenoh import MAPFOLD, Program
from tests.support.rmw import type_hash
from tests.support.ros2dds import KINDS, drive
from tests.support.ros2dds_recordings import envelopes, verbatim
from tests.support.ros_bags import write_bag
from tests.support.ros_messages import START, TYPES

pytest.importorskip("zenoh_ros2_sdk")
pytestmark = pytest.mark.slow

KEYFRAMES = 2_500
ROBOT = """
import sys
import threading
from zenoh_ros2_sdk import ROS2Publisher
from tests.support.rmw import type_hash
from tests.support.rmw import type_hash
from tests.support.ros2dds import KINDS, drive
from tests.support.ros_messages import TYPES

port, keyframes = map(int, sys.argv[1:])
publishers = {
    topic: ROS2Publisher(
        topic=topic, msg_type=kind, msg_definition=TYPES.definition(kind),
        type_hash=type_hash(kind), router_port=port, domain_id=7,
    )
    for topic, kind in KINDS.items()
}
print(*(each.keyexpr for each in publishers.values()), flush=True)
sys.stdin.readline()
for _ in publishers["/tf"].session_mgr.session.get("mapfold/confirm/robot"):
    pass  # when it ends, the session knows of the recorder's subscriptions
for topic, message in drive(keyframes):
    publishers[topic].publish(**vars(message))
sys.stdin.readline()
"""


def test_ten_thousand_messages_of_its_node_are_recorded_and_make_the_map_of_a_bag(
    tmp_path: Path, endpoint: str, start_code: Callable[..., Program]
) -> None:
    sent, port = drive(KEYFRAMES), endpoint.rpartition(":")[2]
    assert len(sent) == 10_002
    with subprocess.Popen(
        [sys.executable, "-c", ROBOT, port, str(KEYFRAMES)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as robot:
        try:
            assert robot.stdin is not None
            assert robot.stdout is not None
            assert len(robot.stdout.readline().split()) == len(KINDS)
            recorder = start_code(
                MAPFOLD, "record", str(tmp_path / "log"), "--connect", endpoint, "--ros2",
                "--domain", "7", "--run-id", "drive", "--json",
            )  # fmt: skip
            recorder.wait_for("Ctrl-C ends it")
            robot.stdin.write("go\n")
            robot.stdin.flush()
            kept = (
                e
                for e in follow(tmp_path / "log", FIRST_OFFSET, stop=threading.Event())
                if e and e.key in KINDS
            )
            assert len([*itertools.islice(kept, len(sent))]) == len(sent)
            assert recorder.end(signal.SIGINT) == 0
        finally:
            robot.kill()
    document = json.loads(recorder.output())
    assert (document["messages"], document["recorded"]) == (len(sent), KEYFRAMES + 1)
    events = read_log(tmp_path / "log")
    assert [e.key for e in verbatim(events)] == [topic for topic, _ in sent]
    times = range(START, START + len(sent))
    bag = write_bag(tmp_path / "bag", [(t, n, m) for n, (t, m) in zip(times, sent, strict=True)])
    with LogWriter(tmp_path / "of-bag") as writer:
        import_files(writer, [str(bag)], bags=BagOptions(run_id="drive"))
    of_bag = [e.payload for e in envelopes(read_log(tmp_path / "of-bag"))]
    assert [e.payload for e in envelopes(events)] == of_bag


def test_its_type_hash_is_that_of_rosbags() -> None:
    from zenoh_ros2_sdk.utils import compute_type_hash_from_msg  # skipped where it is not there

    definition = TYPES.definition("std_msgs/msg/String").partition("=" * 80)[0]
    assert compute_type_hash_from_msg("std_msgs/msg/String", definition) == type_hash(
        "std_msgs/msg/String"
    )
