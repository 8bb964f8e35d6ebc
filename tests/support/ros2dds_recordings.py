"""Recording what a zenoh-bridge-ros2dds sends, and what must come of it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import Event, LogReader, LogWriter, VerbatimEvent
from eventsrc.record.gap_history import ledger_of
from eventsrc.record.recorder.bridged import Bridge, derive
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.transport.session import Session
from eventsrc.ros.assembler import Assembled, Assembler, RosMessage
from eventsrc.ros.wire import topic_of
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.surfaces.cli.bridge_options import BridgeChoice, recording_of
from tests.support import ros2dds
from tests.support.fixtures_log import read_log
from tests.support.fixtures_zenoh import DEADLINE_S
from tests.support.recorders import Running
from tests.support.ros2dds import KINDS, LATCHED, Sent
from tests.support.ros_messages import (
    START,
    TYPES,
)


def choice(namespace: str = "", **more: Any) -> Any:
    return BridgeChoice(
        namespace=namespace, **{"embeddings": "/embeddings", "run_id": "drive"} | more
    )


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
    made = list(derive(events, TYPES))
    recorded = [event for event in events if event.is_envelope or event.key == MAP_KEY]
    assert [each.derived.payload for each in made] == [event.payload for event in recorded]
    for (completed_at, _), event in zip(made, recorded, strict=True):
        between = events[(completed_at or 0) + 1 : event.offset]
        if completed_at is not None:
            assert all(each in recorded for each in between)
        else:
            assert event.offset > max(each.offset for each in verbatim(events))
