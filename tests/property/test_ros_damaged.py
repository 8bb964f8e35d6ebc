"""Messages of ROS whose bytes, lengths, types or topics are wrong: counted, and nothing worse."""

import struct

from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.ros.derivation import Derivation, RosRecording
from eventsrc.ros.stream import Stream
from tests.support import ros_messages as ros
from tests.support.ros_messages import OPTICAL, SECOND, START, flat
from tests.support.ros_streams import stream
from tests.support.thorough import examples

GRID, POSE, ODOMETRY = "/map", "/pose", "/odom"
STREAMS = (
    stream(),
    stream(pose=POSE, covariance=POSE, embeddings="/embeddings", camera="/camera"),
    stream(pose=ODOMETRY),
)
MESSAGES = (
    (
        STREAMS[0].detections,
        ros.detections(START, "optical", ros.detection([("cup", 0.5)], ros.box(9, 9, 5, 5), "a")),
    ),
    ("/embeddings", ros.embeddings(START, [[1.0, 2.0]])),
    ("/camera", ros.camera_info(START, "optical", 500.0)),
    ("/tf", ros.tf(ros.transform("map", "base_link", START, flat(1.0, 2.0, 0.3)))),
    ("/tf_static", ros.tf(ros.transform("base_link", "optical", START, OPTICAL))),
    (POSE, ros.pose_with_covariance(START, "map", flat(1.0, 2.0, 0.3))),
    (ODOMETRY, ros.odometry(START, "odom", "base_link", flat(1.0, 2.0, 0.3))),
    (GRID, ros.grid(START, [0] * 12, 4, 3)),
)
SEEDS = [(t, m.__msgtype__, ros.TYPES.encode(m, m.__msgtype__)) for t, m in MESSAGES]
LENGTHS = st.sampled_from([0, 1, 5, 2**16, 2**30, 2**31 - 1, 2**31, 2**32 - 1])
NUMBERS = st.sampled_from([float("nan"), float("inf"), -float("inf"), 1e308, 1e-320, -0.0])


@st.composite
def damaged(draw: st.DrawFn) -> tuple[str, str, bytes]:
    """Topic, type and bytes of a message; sometimes of different messages."""
    topic, kind, payload = draw(st.sampled_from(SEEDS))
    body = bytearray(payload)
    for _ in range(draw(st.integers(0, 3))):
        at = 4 + draw(st.integers(0, max(len(body) - 12, 0))) // 4 * 4
        match draw(st.integers(0, 3)):
            case 0:
                del body[at:]
            case 1:
                body[at : at + 4] = struct.pack("<I", draw(LENGTHS))
            case 2:
                body[at : at + 8] = struct.pack("<d", draw(NUMBERS))
            case _:
                body[at:at] = draw(st.binary(max_size=9))
    if draw(st.integers(0, 9)) == 0:
        topic = draw(st.sampled_from(SEEDS))[0]
    if draw(st.integers(0, 9)) == 0:
        kind = draw(st.sampled_from(SEEDS))[1]
    return topic, kind, bytes(body)


@settings(max_examples=examples(500), deadline=None)
@given(messages=st.lists(damaged(), max_size=12), made=st.sampled_from(STREAMS))
def test_damaged_messages_are_counted(messages: list[tuple[str, str, bytes]], made: Stream) -> None:
    recording = RosRecording(key="tb/d", streams=(made,), grids=(GRID,))
    derivation = Derivation(recording, ros.TYPES)
    for number, (topic, kind, payload) in enumerate(messages):
        derivation.add(topic, kind, "", START + number * SECOND, payload)
    derivation.finish()
    assert sum(derivation.refused.values()) <= len(messages)
    assert derivation.refused.keys() == derivation.reasons.keys()
