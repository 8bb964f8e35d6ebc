"""`mapfold spool`: what a recorder has refused is listed, sent again or dropped."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from eventsrc.envelope.model import KeyframeId, RunId
from eventsrc.record.robot.acks import Refusal, Refusals
from eventsrc.record.robot.spool import Spool
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload

PAYLOADS = [payload(envelope(number, 0.0)) for number in (1, 2, 3)]


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    """Beside the spool of `mapfold detect`: three envelopes, two of them refused."""
    run = Commands.in_folder(tmp_path)
    spool = Spool(run.home / "detect-spool.sqlite")
    for number, each in enumerate(PAYLOADS, start=1):
        spool.add(RunId("run\x1b[1m"), KeyframeId(number), each)
    last = spool.after(0, 10)[-1].seq
    refusals = tuple(Refusal.of(each, "no embedding") for each in PAYLOADS[:2])
    spool.refuse(Refusals(log_id="log-1", refused=refusals), last)
    spool.close()
    return run


def waiting(run: Commands) -> tuple[list[bytes], int]:
    spool = Spool(run.home / "detect-spool.sqlite")
    try:
        return [each.payload for each in spool.after(0, 10)], spool.refused_count
    finally:
        spool.close()


def test_what_was_refused_is_listed_with_the_reason(mapfold: Commands) -> None:
    said = mapfold("spool", code=3)
    first = said.out.splitlines()[0]
    assert first == r"run\x1b[1m:1  refused by log log-1: no embedding"
    assert len(said.out.splitlines()) == 2
    assert "1 envelope waiting, 2 refused" in said.err
    found = mapfold("spool", "--json", code=3).json
    assert (found["waiting"], found["retried"], found["discarded"]) == (1, 0, 0)
    assert [each["keyframe_id"] for each in found["refused"]] == [1, 2]
    assert waiting(mapfold) == ([PAYLOADS[2]], 2)


def test_the_advised_lines_send_it_again_or_drop_it(mapfold: Commands) -> None:
    said = mapfold("spool", code=3).err
    again, drop = (line.split("mapfold ")[1].split() for line in said.splitlines()[-2:])
    assert "2 envelopes will be sent again" in mapfold(*again).err
    assert waiting(mapfold) == ([PAYLOADS[2], *PAYLOADS[:2]], 0)
    assert "dropped 0 envelopes" in mapfold(*drop).err


def test_dropped_is_dropped(mapfold: Commands) -> None:
    assert mapfold("spool", "--discard", "--json").json["discarded"] == 2
    assert waiting(mapfold) == ([PAYLOADS[2]], 0)
    assert mapfold("spool").out == ""


def test_what_is_no_spool_is_one_line_and_makes_none(mapfold: Commands, tmp_path: Path) -> None:
    said = mapfold("spool", "none.sqlite", code=2).err
    assert said.startswith("mapfold: none.sqlite: no such file")
    assert not (tmp_path / "none.sqlite").exists()
    (tmp_path / "text").write_text("no database, but long enough to be taken for one " * 100)
    assert mapfold("spool", "text", code=1).err.count("\n") == 1
    assert "--retry and --discard" in mapfold("spool", "--retry", "--discard", code=2).err


def test_another_programs_database_is_refused_and_left_as_it_is(mapfold: Commands) -> None:
    other = mapfold.folder / "other #1?.db"
    with closing(sqlite3.connect(other)) as db:
        db.execute("create table notes (text)")
    before = other.read_bytes()
    said = mapfold("spool", other, "--discard", code=2)
    assert "another program's database" in said.err
    assert other.read_bytes() == before
