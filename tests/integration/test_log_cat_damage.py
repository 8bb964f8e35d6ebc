"""`mapfold log cat` of a log with damage in the middle: it stops there, or reports it and
continues; a range without the damage is not affected."""

from pathlib import Path

import pytest

from eventsrc.base.errors import LogError
from eventsrc.log import LogReader, LogWriter
from projections.surfaces.cli.event_text import iso_time
from tests.support.commands import Commands
from tests.support.fixtures_log import BY_HAND, KEY, envelope, flip

SECOND = 1_000_000_000
CHUNK = 100
"""Events in a chunk: of 300, the middle hundred cannot be read."""


def at(second: int) -> str:
    return iso_time(second * SECOND)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    """Commands beside the log L: keyframe k of run r1 at second k."""
    folder = tmp_path_factory.mktemp("rotten")
    log = folder / "L"
    with LogWriter(log, fsync=BY_HAND) as writer:
        for k in range(3 * CHUNK):
            payload = envelope(k, "r1", note="x" * 12_000)
            writer.append(KEY, payload, stamp_ns=k * SECOND)
            if k % CHUNK == CHUNK - 1:
                writer.sync()
    with LogReader(log) as reader:
        (segment,) = reader.segments
        chunks = reader.open_segment(segment).chunks
        assert [chunk.first for chunk in chunks] == [0, 100, 200]
    flip(segment.path, chunks[1].position + chunks[1].length // 2)
    return Commands.in_folder(folder)


def shown(out: str) -> list[int]:
    return [int(line.split()[0]) for line in out.splitlines()]


@pytest.mark.parametrize(
    "ends",
    [("--from", "r1:250", "--to", "r1:260"), ("--from", at(250), "--to", at(260))],
    ids=["keyframes", "times"],
)
def test_a_range_behind_the_damage(run: Commands, ends: tuple[str, ...]) -> None:
    said = run("log", "cat", "L", *ends, "--skip-damage", code=3)
    assert shown(said.out) == list(range(250, 261))
    assert said.err.count("offsets 100 to 199 cannot be read") == 1
    said = run("log", "cat", "L", *ends, code=1)
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert "offsets 100 to 199 cannot be read" in said.err


@pytest.mark.parametrize(
    "ends",
    [("--from", "r1:20", "--to", "r1:30"), ("--from", at(20), "--to", at(30))],
    ids=["keyframes", "times"],
)
@pytest.mark.parametrize("asked", [(), ("--skip-damage",)], ids=["", "skip"])
def test_a_range_before_the_damage(
    run: Commands, ends: tuple[str, ...], asked: tuple[str, ...]
) -> None:
    said = run("log", "cat", "L", *ends, *asked)
    assert shown(said.out) == list(range(20, 31))
    assert said.err == ""


def test_a_range_around_the_damage(run: Commands) -> None:
    ends = ("--from", at(98), "--to", at(201))
    said = run("log", "cat", "L", *ends, "--skip-damage", code=3)
    assert shown(said.out) == [98, 99, 200, 201]
    assert said.err.count("cannot be read") == 1
    said = run("log", "cat", "L", *ends, code=1)
    assert shown(said.out) == [98, 99]
    assert "offsets 100 to 199 cannot be read" in said.err


@pytest.mark.parametrize("to", ["r1:250", "r1:150", "r1:1000"])
def test_events_before_the_damage_are_shown_when_to_is_a_keyframe_behind_it(
    run: Commands, to: str
) -> None:
    said = run("log", "cat", "L", "--from", "98", "--to", to, code=1)
    assert shown(said.out) == [98, 99]
    assert said.err.count("\n") == 1
    assert "offsets 100 to 199 cannot be read" in said.err


@pytest.mark.parametrize("to", ["r1:25", at(25), "end", "r1:99"])
def test_events_before_rot_at_the_end_of_a_growing_segment_are_shown(
    tmp_path: Path, to: str
) -> None:
    log = tmp_path / "L"
    writer = LogWriter(log, fsync=BY_HAND)
    (active,) = log.glob("*.active")
    ends = []
    for k in range(30):
        writer.append(KEY, envelope(k, "r1"), stamp_ns=k * SECOND)
        if k % 10 == 9:
            writer.sync()
            ends.append(active.stat().st_size)
    flip(active, ends[1] - 10)
    with pytest.raises(LogError, match="log recover"):
        writer.close()
    said = Commands.in_folder(tmp_path)("log", "cat", "L", "--to", to, code=1)
    assert shown(said.out) == list(range(10))
    assert said.err.count("\n") == 1
    assert "offsets 10 to 29 cannot be read" in said.err
    assert "run `mapfold log" in said.err


def test_a_range_that_ends_somewhere_in_the_damage(run: Commands) -> None:
    said = run("log", "cat", "L", "--from", at(98), "--to", at(150), "--skip-damage", code=3)
    assert shown(said.out) == [98, 99]
    assert "offsets 100 to 199 cannot be read" in said.err


def test_the_map_at_a_time_before_the_damage(run: Commands) -> None:
    assert run("state", "L", "--at", at(30), "--json").json["offset"] == 31
    said = run("state", "L", "--at", at(201), code=1)
    assert "offsets 100 to 199 cannot be read" in said.err
