"""Recordings of a bridge that go on, were killed, were damaged or are imported."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.system_events import LOSS_KEY, MAP_KEY, ROS_KEY, Loss
from eventsrc.log import LogReader, LogWriter, MessageFormat, NewEvent, VerbatimEvent, verify_log
from eventsrc.record.gap_history import ledger_of
from eventsrc.record.importers.run import import_files
from eventsrc.record.recorder.bridged import Bridge, append_missing, derive
from eventsrc.record.recorder.checking import Checker
from eventsrc.record.recorder.queue import BridgedMessage, MessageQueue
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.transport.session import Session
from eventsrc.ros.derivation import RosRecording, read_recording
from projections.surfaces.cli.bridge_options import recording_of
from tests.support import ros2dds
from tests.support.fixtures_log import KEY, read_log
from tests.support.recorders import Running
from tests.support.ros2dds import BOXES, KINDS, drive
from tests.support.ros2dds_recordings import (
    announce_all,
    check_derived,
    choice,
    envelopes,
    new_bridge,
    recording,
    send_all,
    verbatim,
)
from tests.support.ros_messages import (
    START,
    TYPES,
)

Sessions = Callable[[], Session]


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
        ready = [d.payload for _, d in derive(events[:end], TYPES)]
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
    with LogWriter(tmp_path / "copy") as writer, LogReader(log_path) as reader:
        again = import_files(writer, [str(log_path)], ledger=ledger_of(reader))
    assert (again.known, again.next_offset) == (len(events), len(events))
    with LogWriter(tmp_path / "copy") as writer:
        writer.append(ROS_KEY, b'{"key": 3}')
    (finding,) = verify_log(tmp_path / "copy").findings
    assert finding.kind == "schema"
    assert "mapfold/ros event cannot be read" in finding.message


def test_a_recording_event_is_read_back() -> None:
    how, _ = recording_of(choice("bot1", camera="/camera/camera_info"), 0, None)
    assert read_recording(how.encode()) == how
    assert read_recording(RosRecording(key=KEY).encode()).streams == ()
