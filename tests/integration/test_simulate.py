"""`mapfold simulate` over a real router and into files, as a user runs it."""

import json
import os
import queue
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.record.transport.session import Received, Session
from tests.support.commands import Commands, Said
from tests.support.fixtures_zenoh import DEADLINE_S, Program
from tests.support.logs import simulated


def _mapfold(*arguments: str) -> Said:
    return Commands(Path.cwd(), os.environ)(*arguments, code=None)


def test_every_keyframe_arrives_byte_for_byte_and_in_order(
    endpoint: str, connected: Callable[[], Session], start: Callable[..., Program]
) -> None:
    received: queue.Queue[Received] = queue.Queue()
    session = connected()
    session.subscribe("tb/**", received.put)
    session.confirm()
    program = start("simulate", "--run", "b", "--speed", "0", "--connect", endpoint)
    assert program.wait() == 0, program.lines
    payloads = list(simulated(run="b").payloads)
    arrived = [received.get(timeout=DEADLINE_S) for _ in payloads]
    assert [message.payload for message in arrived] == payloads
    assert {message.key for message in arrived} == {"tb/detections"}
    assert f"published {len(payloads)} on tb/detections" in program.lines[-1]


@pytest.mark.slow
def test_simulate_without_a_subscriber_is_one_line(
    endpoint: str, start: Callable[..., Program]
) -> None:
    program = start("simulate", "--wait", "0.2", "--connect", endpoint)
    assert program.wait() == 1
    (line,) = program.lines
    assert "no one subscribed to 'tb/detections' within 0.2 s" in line
    assert "mapfold record" in line


def test_a_file_is_written_with_its_numbers(tmp_path: Path) -> None:
    out = tmp_path / "run.jsonl.gz"
    done = _mapfold("simulate", "--run", "b", "--out", str(out), "--json")
    numbers = json.loads(done.out)
    run = simulated(run="b")
    assert numbers["run_id"] == run.run_id
    assert numbers["keyframes"] == len(run.envelopes)
    assert Path(numbers["out"]).exists()
    assert Path(numbers["truth"]).name == "run.truth.jsonl.gz"
    assert f"{len(run.envelopes)} keyframes" in done.err
    assert f"truth in {tmp_path / 'run.truth.jsonl.gz'}" in done.err


@pytest.mark.parametrize("name", ["", "two\nlines", "x" * 101])
def test_an_unprintable_empty_or_long_run_name_is_misuse(name: str) -> None:
    done = _mapfold("simulate", "--run", name, "--out", "never.jsonl")
    assert done.code == 2
    assert "give a name of 1 to 100 printable characters" in done.err
    assert not Path("never.jsonl").exists()


@pytest.mark.slow
def test_an_unwritable_place_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = _mapfold("simulate", "--out", str(tmp_path / "file" / "x.jsonl"))
    assert done.code == 2
    assert len(done.err.strip().splitlines()) == 1
    assert "cannot be written" in done.err
