"""A peer in DDS: Cyclone makes the CDR and sends it over loopback; a small bridge passes it on."""

import uuid
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.log import VerbatimEvent
from eventsrc.record.transport.session import Session
from tests.support import ros2dds
from tests.support.fixtures_log import read_log
from tests.support.fixtures_zenoh import DEADLINE_S, Program
from tests.support.ros2dds import KINDS, drive
from tests.support.ros2dds_recordings import (
    announce_all,
    check_derived,
    envelopes,
    expected_envelopes,
    new_bridge,
    recording,
    wait_for_recorder,
)
from tests.support.ros_messages import TYPES

KEYFRAMES = 12
WRITER = "from tests.support.dds import main; main()"


@pytest.mark.parametrize("number", range(4))
def test_cyclone_and_rosbags_make_the_same_cdr(number: int) -> None:
    from tests.support import dds

    for _, message in drive(number + 1):
        own = TYPES.encode(message, message.__msgtype__)
        assert dds.to_idl(message).serialize(use_version_2=False) == own
        assert dds.idl_type(message.__msgtype__).deserialize(own) == dds.to_idl(message)


@pytest.mark.seconds
def test_a_drive_over_dds_and_a_bridge(
    log_path: Path,
    endpoint: str,
    connected: Callable[[], Session],
    start_code: Callable[..., Program],
) -> None:
    from cyclonedds.core import InstanceState as State
    from cyclonedds.core import ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.sub import DataReader
    from cyclonedds.util import duration

    from tests.support import dds

    sent = drive(KEYFRAMES)
    tag = uuid.uuid4().hex
    with dds.participant(tag) as own:
        readers = {
            name: DataReader(own, dds.topic(own, name, kind), qos=dds.QOS)
            for name, kind in KINDS.items()
        }
        start_code(WRITER, tag, str(KEYFRAMES))
        waits = WaitSet(own)
        for reader in readers.values():
            waits.attach(ReadCondition(reader, SampleState.Any | ViewState.Any | State.Any))
        got: dict[str, list[bytes]] = {name: [] for name in KINDS}
        while sum(map(len, got.values())) < len(sent):
            assert waits.wait(duration(seconds=DEADLINE_S)) > 0
            for name, reader in readers.items():
                got[name] += dds.raw_samples(reader)
    for name in KINDS:
        own_cdr = [TYPES.encode(m, m.__msgtype__) for topic, m in sent if topic == name]
        padded = [cdr + bytes(-len(cdr) % 4) for cdr in own_cdr]  # as RTPS sends it
        assert got[name] == padded
    left = {name: iter(payloads) for name, payloads in got.items()}
    with (
        ros2dds.bridge(endpoint, namespace="bot1") as bridge,
        recording(connected(), log_path, new_bridge("bot1")) as running,
    ):
        announce_all(bridge)
        for name in KINDS:
            wait_for_recorder(bridge, name)
        for name, _ in sent:
            bridge.send_raw(name, next(left[name]))
        running.wait_until(lambda r: r.messages >= len(sent))
    events = read_log(log_path)
    assert [e.payload for e in envelopes(events)] == expected_envelopes(sent, "bot1")
    check_derived(log_path)
    for event in events:
        if isinstance(event, VerbatimEvent):
            idl = dds.idl_type(event.format.schema)
            again = idl.deserialize(event.payload).serialize(use_version_2=False)
            assert again + bytes(-len(again) % 4) == event.payload
