"""Files imported in any order: an older one behind a newer one is no clock that ran backwards."""

import json
from itertools import pairwise
from pathlib import Path

import pytest

from eventsrc.log.format import list_segments
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY, read_log
from tests.support.thorough import mostly_slow

HOUR = 3600
DRIVES = {"new": 20 * HOUR, "mid": 10 * HOUR, "old": HOUR}
"""When each drive began, in seconds."""
ORDERS = (("new", "mid", "old"), ("mid", "old", "new"))


def lines(name: str, *, received: bool, count: int = 4) -> bytes:
    """A drive as JSON lines; with ``received`` each says when a logger received it."""
    made = []
    for number in range(count):
        stamp = float(DRIVES[name] + number)
        document = {**envelope(number, 0.0, run_id=name), "timestamp": stamp}
        made.append({"ts": stamp + 0.5, "key": KEY, "payload": document} if received else document)
    return b"\n".join(map(payload, made))


@pytest.fixture(params=mostly_slow([False, True]), ids=["stamped", "received"])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Commands:
    for name in DRIVES:
        (tmp_path / f"{name}.jsonl").write_bytes(lines(name, received=request.param))
    return Commands.in_folder(tmp_path)


def segments(log: Path) -> int:
    return len(list_segments(log))


def test_older_files_behind_newer_ones_are_no_finding(run: Commands) -> None:
    for number, order in enumerate(ORDERS):
        log = run.folder / f"L{number}"
        run("import", log.name, *(f"{name}.jsonl" for name in order))
        assert "all good" in run("log", "verify", log.name).err
        events = read_log(log)
        in_order = [name for name in order for _ in range(4)]
        assert [json.loads(event.payload)["run_id"] for event in events] == in_order
        older = sum(DRIVES[two] < DRIVES[one] for one, two in pairwise(order))
        assert segments(log) == 1 + older
        back = sum(two.logged_ns < one.logged_ns for one, two in pairwise(events))
        assert back == older


def test_a_copy_of_such_a_log_is_good_too(run: Commands) -> None:
    run("import", "L", "new.jsonl", "old.jsonl")
    run("import", "L", "mid.jsonl")
    run("import", "copy", "L")
    assert "all good" in run("log", "verify", "copy").err
    assert [event.logged_ns for event in read_log(run.folder / "copy")] == [
        event.logged_ns for event in read_log(run.folder / "L")
    ]


def test_the_map_is_that_of_one_file(run: Commands) -> None:
    run("import", "files", "new.jsonl", "old.jsonl")
    joined = b"\n".join((run.folder / f"{name}.jsonl").read_bytes() for name in ("new", "old"))
    run("import", "one", "-", stdin=joined)
    digests = {run("state", log, "--digest").out for log in ("files", "one")}
    assert len(digests) == 1


def test_a_clock_that_was_set_back_inside_a_file_is_still_found(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    both = lines("new", received=True) + b"\n" + lines("old", received=True)
    (tmp_path / "both.jsonl").write_bytes(both)
    (tmp_path / "mid.jsonl").write_bytes(lines("mid", received=True))
    run("import", "L", "mid.jsonl", "both.jsonl")
    assert "logged_ns runs backwards" in run("log", "verify", "L", code=3).out


def test_an_empty_file_between_changes_nothing(run: Commands) -> None:
    (run.folder / "none.jsonl").write_bytes(b"\n\n")
    run("import", "L", "new.jsonl", "none.jsonl", "old.jsonl", "none.jsonl")
    assert "all good" in run("log", "verify", "L").err
    assert segments(run.folder / "L") == 2
