"""`mapfold edit` on a log that `mapfold record` holds: commands go to it over Zenoh."""

import random
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from eventsrc.envelope.commands import Command, parse_command
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_zenoh import Program
from tests.support.logs import EVENTS, FAR, LEFT, RIGHT, write_rooms
from tests.support.thorough import mostly_slow, stride

Start = Callable[..., Program]
WHY = ("--reason", "why")


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    write_rooms(tmp_path / "log")
    return Commands.in_folder(tmp_path)


@pytest.fixture
def recorder(start: Start, endpoint: str, mapfold: Commands) -> Callable[..., Program]:
    """Starts a recorder of the log and waits until it takes messages."""

    def run(*options: str) -> Program:
        program = start("record", str(mapfold.folder / "log"), "--connect", endpoint, *options)
        program.wait_for("taking commands" if "--accept-edits" in options else "recording")
        return program

    return run


def _commands(log: Path) -> list[Command]:
    with LogReader(log) as reader:
        return [parse_command(e.payload) for e in reader.read(keys={COMMAND_KEY})]


def test_the_recorder_appends_and_the_offset_comes_back(
    mapfold: Commands, recorder: Start, publish: Start, endpoint: str
) -> None:
    running = recorder("--accept-edits")
    connect = ("--connect", endpoint)
    given = mapfold("edit", "log", "forget-run", "run-b", *WHY, *connect, "--json").json
    assert given["offset"] == EVENTS
    assert given["effect"] == {"places": 1, "objects": 0, "keyframes": 5}
    sent = [payload(envelope(k, 100.0, run_id="run-c")).decode() for k in range(3)]
    assert publish("tb/detections", *sent).wait() == 0
    running.end(signal.SIGINT)
    assert running.wait() == 0
    assert "1 command of mapfold edit, 34 events in the log" in running.lines[-1]
    undo = mapfold("edit", "log", "undo", given["command_id"], *WHY).out
    assert f"undo recorded at offset {EVENTS + 4}" in undo
    counts = mapfold("state", "log", "--json").json["counts"]
    assert (counts["keyframes"], counts["places"]) == (33, 3)


def test_a_recorder_that_takes_no_edits_is_named_with_the_next_step(
    mapfold: Commands, recorder: Start, endpoint: str
) -> None:
    running = recorder()
    said = mapfold("edit", "log", "forget-run", "run-b", *WHY, "--connect", endpoint, code=1)
    (line,) = said.err.splitlines()
    assert f"log is being written by process {running.process.pid} on" in line
    assert "start the recorder with --accept-edits, or stop it and edit again" in line
    assert _commands(mapfold.folder / "log") == []


def test_without_its_router_the_recorder_is_named_too(mapfold: Commands, recorder: Start) -> None:
    recorder("--accept-edits")
    away = "tcp/127.0.0.1:9"
    said = mapfold("edit", "log", "forget-run", "run-b", *WHY, "--connect", away, code=1)
    (line,) = said.err.splitlines()
    assert "log is being written by process" in line
    assert f"no Zenoh router or peer answers at {away}" in line


def test_a_dry_run_needs_no_recorder(mapfold: Commands, recorder: Start) -> None:
    recorder()
    said = mapfold("edit", "log", "forget-run", "run-b", "--dry-run").out
    assert "would change 1 place, 0 objects, 5 keyframes; nothing is recorded" in said


def test_contradictions_are_refused_also_when_they_come_at_once(
    mapfold: Commands, recorder: Start, endpoint: str
) -> None:
    """Each is made from the map as the one before left it: one is recorded, the other refused."""
    recorder("--accept-edits")

    def give(kind: str) -> int:
        args = ("edit", "log", kind, LEFT, FAR, *WHY, "--connect", endpoint)
        return mapfold(*args, code=None).code

    with ThreadPoolExecutor(2) as threads:
        assert sorted(threads.map(give, ("join", "keep-apart"))) == [0, 2]
    assert len(_commands(mapfold.folder / "log")) == 1


def test_a_log_with_an_event_that_is_no_command_is_recorded_without_edits(
    mapfold: Commands, start: Start, endpoint: str
) -> None:
    with LogWriter(mapfold.folder / "log") as writer:
        writer.append(COMMAND_KEY, b"{}")
    log = str(mapfold.folder / "log")
    running = start("record", log, "--connect", endpoint, "--accept-edits")
    assert "offset 30 is no command" in running.wait_for("recording without edits")
    running.wait_for("taking commands")
    assert running.end(signal.SIGTERM) == 0


@pytest.mark.parametrize("seed", mostly_slow(range(0, 3, stride(2))))
def test_a_command_is_recorded_once_whichever_process_is_killed(
    mapfold: Commands, recorder: Start, endpoint: str, seed: int
) -> None:
    """The recorder or `edit` is killed in the middle; the same command is then given again."""
    rng = random.Random(seed)
    log, ids = mapfold.folder / "log", []
    dry = ("edit", "log", "name-place", RIGHT, "n", *WHY, "--dry-run")
    whole_s = 1.5 * mapfold.seconds(*dry)  # through a recorder it takes longer
    for number in range(3):
        running = recorder("--accept-edits")
        ids.append(f"c{number}")
        args = ("edit", "log", "name-place", RIGHT, f"n{number}", *WHY)
        give = (*args, "--command-id", ids[-1], "--connect", endpoint)
        process = mapfold.start(*give)
        victim = rng.choice([process, running.process])
        killer = threading.Timer(rng.uniform(0.0, whole_s), victim.send_signal, [signal.SIGKILL])
        killer.start()
        process.wait()
        killer.cancel()
        killer.join()
        recorded = [c.command_id for c in _commands(log)]
        assert recorded in (ids, ids[:-1])
        mapfold(*give)  # by the recorder, or by itself where that is gone
        assert [c.command_id for c in _commands(log)] == ids
        running.close()
