"""`mapfold record` in a process of its own: what it says, how it ends, what it refuses."""

import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.log import LogReader, LogWriter
from eventsrc.router import Router
from tests.envelopes import envelope, payload
from tests.fixtures_zenoh import LOOPBACK, PUBLISHER, Program

Start = Callable[..., Program]
KEY = "tb/detections"


def _stored(log: Path) -> list[bytes]:
    with LogReader(log) as reader:
        return [event.payload for event in reader.read()]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_drains_the_queue_and_exits_0(
    start: Start, publish: Start, endpoint: str, tmp_path: Path, number: int
) -> None:
    log = tmp_path / "log"
    sent = [payload(envelope(k)) for k in range(30)]
    recorder = start("record", str(log), "--connect", endpoint, "--json")
    assert f"recording {KEY} to {log} from offset 0" in recorder.wait_for("recording")
    assert publish(KEY, *(p.decode() for p in sent)).wait() == 0
    assert recorder.end(number) == 0
    assert _stored(log) == sent
    assert recorder.lines[-1].endswith(
        "30 recorded, 0 rejected, 0 lost, 0 keyframes missing; 30 events in the log"
    )
    assert json.loads(recorder.output())["recorded"] == 30


def test_a_rejected_payload_is_exit_3(
    start: Start, publish: Start, endpoint: str, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    recorder = start("record", str(log), "--connect", endpoint, "--max-events", "2")
    recorder.wait_for("recording")
    publish(KEY, payload(envelope(1)).decode(), "[]")
    assert recorder.wait() == 3
    assert "1 recorded, 1 rejected" in recorder.lines[-1]


def test_without_a_router_it_is_one_line_and_no_log(start: Start, tmp_path: Path) -> None:
    with Router(LOOPBACK) as gone:
        (away,) = gone.endpoints
    recorder = start("record", str(tmp_path / "log"), "--connect", away)
    assert recorder.wait() == 1
    (line,) = recorder.lines
    assert line.startswith(f"mapfold: no Zenoh router or peer answers at {away}; start one with")
    assert not (tmp_path / "log").exists()


def test_robots_may_call_a_recorder_without_any_router(
    start: Start, start_code: Start, tmp_path: Path
) -> None:
    with Router(LOOPBACK) as gone:
        (free,) = gone.endpoints
    log = tmp_path / "log"
    recorder = start("record", str(log), "--listen", free, "--max-events", "1")
    recorder.wait_for("recording")
    assert start_code(PUBLISHER, free, KEY, payload(envelope(1)).decode()).wait() == 0
    assert recorder.wait() == 0
    assert len(_stored(log)) == 1


def test_a_second_recorder_is_told_who_holds_the_log(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    with LogWriter(tmp_path / "log"):
        recorder = start("record", str(tmp_path / "log"), "--connect", endpoint)
        assert recorder.wait() == 1
    (line,) = recorder.lines
    assert line.startswith("mapfold: ")
    assert str(tmp_path / "log") in line


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
