"""`mapfold record` in a process of its own: what it says, how it ends, what it refuses."""

import json
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh

from eventsrc.log import LogReader, LogWriter
from eventsrc.record.append import append_payload
from eventsrc.record.gap_history import unread_events
from eventsrc.record.robot.acks import ack_key
from eventsrc.record.transport.session import Router, Session
from tests.support.commands import PROGRAM
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY, read_log
from tests.support.fixtures_zenoh import DEADLINE_S, LOOPBACK, PUBLISHER, Program

Start = Callable[..., Program]


Sessions = Callable[[], Session]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_drains_the_queue_and_exits_0(
    start: Start, publish: Start, endpoint: str, tmp_path: Path, number: int
) -> None:
    log = tmp_path / "log"
    sent = [payload(envelope(k)) for k in range(30)]
    recorder = start("record", str(log), "--connect", endpoint, "--json")
    assert f"recording {KEY} to {log} from offset 0" in recorder.wait_for("recording")
    assert publish(KEY, *(p.decode() for p in sent)).wait() == 0
    assert recorder.end(number) == 0
    assert [event.payload for event in read_log(log)] == sent
    assert recorder.lines[-1].endswith(
        "30 recorded, 0 rejected, 0 lost, 0 keyframes missing; 30 events in the log"
    )
    assert json.loads(recorder.output()) == {
        "recorded": 30,
        "rejected": 0,
        "queue_full": 0,
        "transport_missed": 0,
        "unwritten": 0,
        "lost_from_log": 0,
        "missing": 0,
        "next_offset": 30,
        "unsealed": 0,
        "sealing_error": None,
        "commands": 0,
        "crops": 0,
        "messages": 0,
        "untyped": 0,
        "unread": 0,
        "recovered_segments": 0,
        "recovered_events": 0,
        "torn_bytes": 0,
        "torn_events": 0,
    }


def test_a_message_over_the_limit_is_rejected(
    start: Start, publish: Start, endpoint: str, tmp_path: Path
) -> None:
    fits = payload(envelope(1))
    limit = str(len(fits))
    arguments = ("record", str(tmp_path / "log"), "--connect", endpoint, "--max-payload", limit)
    recorder = start(*arguments, "--max-events", "2")
    recorder.wait_for("recording")
    publish(KEY, fits.decode(), fits.decode() + " ")
    assert recorder.wait() == 3
    assert "1 recorded, 1 rejected" in recorder.lines[-1]


def test_a_rejected_payload_is_exit_3(
    start: Start, publish: Start, endpoint: str, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    recorder = start("record", str(log), "--connect", endpoint, "--max-events", "2")
    recorder.wait_for("recording")
    publish(KEY, payload(envelope(1)).decode(), "[]")
    assert recorder.wait() == 3
    assert "1 recorded, 1 rejected" in recorder.lines[-1]


@pytest.mark.parametrize(("option", "code", "losses"), [("--gaps", 3, 2), ("--no-gaps", 0, 0)])
def test_no_gaps_is_for_robots_that_do_not_count_by_one(
    start: Start,
    publish: Start,
    endpoint: str,
    tmp_path: Path,
    option: str,
    code: int,
    losses: int,
) -> None:
    log = tmp_path / "log"
    recorder = start("record", str(log), "--connect", endpoint, "--max-events", "3", option)
    recorder.wait_for("recording")
    publish(KEY, *(payload(envelope(k * 15)).decode() for k in range(3)))
    assert recorder.wait() == code
    assert len(read_log(log)) == 3 + losses


def test_without_a_router_it_is_one_line_and_no_log(start: Start, tmp_path: Path) -> None:
    with Router(LOOPBACK) as gone:
        (away,) = gone.endpoints
    recorder = start("record", str(tmp_path / "log"), "--connect", away)
    assert recorder.wait() == 1
    (line,) = recorder.lines
    assert line == (
        f"mapfold: no Zenoh router or peer answers at {away}; start one with `mapfold router"
        f" --listen {away}` or say where it is with --connect"
    )
    assert not (tmp_path / "log").exists()


def test_a_robot_can_connect_to_a_recorder_without_a_router(
    start: Start, start_code: Start, tmp_path: Path
) -> None:
    with Router(LOOPBACK) as gone:
        (free,) = gone.endpoints
    log = tmp_path / "log"
    recorder = start("record", str(log), "--listen", free, "--max-events", "1")
    recorder.wait_for("recording")
    assert start_code(PUBLISHER, free, KEY, payload(envelope(1)).decode()).wait() == 0
    assert recorder.wait() == 0
    assert len(read_log(log)) == 1


def test_a_second_recorder_is_refused_with_the_name_of_the_holder(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    with LogWriter(tmp_path / "log"):
        recorder = start("record", str(tmp_path / "log"), "--connect", endpoint)
        assert recorder.wait() == 1
    (line,) = recorder.lines
    assert line.startswith("mapfold: ")
    holder = f"process {os.getpid()} on {socket.gethostname()} since 20"
    assert f"{tmp_path / 'log'} is being written by {holder}" in line


def test_a_folder_that_is_no_log_is_one_line_and_exit_2(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    (tmp_path / "holiday.jpg").touch()
    recorder = start("record", str(tmp_path), "--connect", endpoint)
    assert recorder.wait() == 2
    assert len(recorder.lines) == 1


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--fsync", "sometimes"), "--fsync 'sometimes'"),
        (("--key", "a//b"), "'a//b'"),
        (("--key", "a/*", "--key", "a/b"), "overlap"),
    ],
)
def test_misuse_is_one_line_and_exit_2(
    start: Start, endpoint: str, tmp_path: Path, arguments: tuple[str, ...], complaint: str
) -> None:
    recorder = start("record", str(tmp_path / "log"), "--connect", endpoint, *arguments)
    assert recorder.wait() == 2
    (line,) = recorder.lines
    assert complaint in line
    assert not (tmp_path / "log").exists()


@pytest.mark.slow
def test_what_zenoh_drops_while_the_recorder_stands_still_is_counted(
    start: Start, endpoint: str, connected: Sessions, tmp_path: Path
) -> None:
    """Some ten seconds: the router gives the recorder up, and then drops what comes for it."""
    log = tmp_path / "log"
    recorder = start("record", str(log), "--connect", endpoint, "--json")
    recorder.wait_for("recording")
    session = connected()
    publisher = zenoh.ext.declare_advanced_publisher(
        session.raw,
        KEY,
        congestion_control=zenoh.CongestionControl.BLOCK,
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=1.0, sporadic_heartbeat=None),
    )
    watch = session.publisher(KEY)
    assert watch.wait_for_subscriber(DEADLINE_S)
    acked = threading.Event()
    session.subscribe(ack_key("run-a"), lambda _: acked.set())
    session.confirm()
    publisher.put(payload(envelope(0)))
    assert acked.wait(DEADLINE_S)
    recorder.process.send_signal(signal.SIGSTOP)
    sent = 1
    while watch.has_subscriber:
        publisher.put(payload(envelope(sent, note="x" * 10_000)))
        sent += 1
    recorder.process.send_signal(signal.SIGCONT)
    assert watch.wait_for_subscriber(DEADLINE_S)
    recorder.wait_for("LOST")
    acked.clear()
    publisher.put(payload(envelope(sent)))
    assert acked.wait(DEADLINE_S)
    assert recorder.end(signal.SIGINT) == 3
    numbers = json.loads(recorder.output())
    assert numbers["recorded"] + numbers["transport_missed"] == sent + 1
    assert numbers["missing"] == numbers["transport_missed"] > 0


def test_the_ledger_is_saved_soon_after_the_start(
    start: Start, publish: Start, endpoint: str, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    with LogWriter(log) as writer:
        for k in range(20):
            append_payload(writer, KEY, payload(envelope(k)))
    first = start("record", str(log), "--connect", endpoint)
    first.wait_for("recording")
    first.end(signal.SIGKILL)
    assert _unread(log) == 0
    second = start("record", str(log), "--connect", endpoint)
    second.wait_for("recording")
    publish(KEY, *(payload(envelope(k)).decode() for k in range(20, 25)))
    deadline, pause = time.monotonic() + DEADLINE_S, threading.Event()
    while _known(log) < 25:
        assert time.monotonic() < deadline, "nothing saved although the recorder is at work"
        pause.wait(0.05)
    second.end(signal.SIGKILL)
    assert _unread(log) == 0


def _unread(log: Path) -> int:
    with LogReader(log) as reader:
        return unread_events(reader)


def _known(log: Path) -> int:
    """How many events the saved ledger knows."""
    with LogReader(log) as reader:
        return reader.next_offset - unread_events(reader)


def test_a_full_stderr_does_not_end_a_recording(
    publish: Start, endpoint: str, tmp_path: Path
) -> None:
    """What it says goes to a file on a full disk; the log is on another one."""
    log = tmp_path / "log"
    args = [str(PROGRAM), "record", str(log), "--connect", endpoint, "--max-events", "2"]
    with Path("/dev/full").open("wb") as full, subprocess.Popen(args, stderr=full) as recorder:
        assert publish(KEY, "no envelope", payload(envelope(1)).decode()).wait() == 0
        assert recorder.wait(DEADLINE_S) == 3  # one was rejected
    assert len(read_log(log)) == 2
