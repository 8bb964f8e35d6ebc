"""`mapfold log verify` and `recover` as a person runs them."""

import errno
import os
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from eventsrc.base.errors import LogError
from eventsrc.log import recover_log
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import flip

PAYLOADS = [payload(envelope(i)) for i in range(1, 6)]


@pytest.fixture
def run(tmp_path: Path) -> Commands:
    """Commands in an empty folder with a sealed log L of five events."""
    run = Commands.in_folder(tmp_path)
    run("import", "L", "-", stdin=b"\n".join(PAYLOADS))
    return run


def segment(run: Commands) -> Path:
    return run.folder / "L" / "00000000000000000000.mcap"


def test_a_good_log(run: Commands) -> None:
    assert "all good" in run("log", "verify", "L").err
    report = run("log", "verify", "L", "--json").json
    assert (report["events"], report["segments"], report["findings"]) == (5, 1, [])
    assert "nothing to recover" in run("log", "recover", "L").err


@pytest.mark.slow
def test_a_rotten_log(run: Commands) -> None:
    flip(segment(run), 500)
    findings = run("log", "verify", "L", "--json", code=3).json["findings"]
    assert [(f["kind"], f["first_offset"], f["last_offset"]) for f in findings] == [
        ("crc", None, None),
        ("gap", 0, 4),
    ]
    assert "offsets 0 to 4" in run("log", "verify", "L", code=3).out
    said = run("log", "cat", "L", code=1)
    assert said.err.count("\n") == 1
    assert "offsets 0 to 4" in said.err
    said = run("log", "cat", "L", "--skip-damage", code=3)
    assert (said.out, "offsets 0 to 4" in said.err) == ("", True)
    report = run("log", "recover", "L", "--json", code=3).json
    assert report["segments"][0]["lost_events"] == 5
    assert report["segments"][0]["kept_copy"] == "00000000000000000000.mcap.damaged"
    assert run("log", "info", "L", "--json").json["lost"] == 5
    run("import", "L", "-", stdin=PAYLOADS[0])
    (event, *_) = run("log", "cat", "L", "--json", "--from", "5").lines
    assert event["offset"] == 5
    for name in ("logged", "stamp"):
        since = datetime.fromisoformat(event[name]) - datetime(1970, 1, 1, tzinfo=UTC)
        assert since // timedelta(microseconds=1) == event[f"{name}_ns"] // 1000


def test_a_flip_that_touches_no_event_loses_none(run: Commands) -> None:
    flip(segment(run), -40)
    assert "no event is affected" in run("log", "verify", "L", code=3).out
    run("log", "recover", "L", code=0)
    run("log", "verify", "L")
    assert len(run("log", "cat", "L").out.splitlines()) == 5


def test_the_original_is_kept_where_no_file_can_have_two_names(
    run: Commands, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On exFAT, for example."""

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    log = run.folder / "L"
    flip(segment(run), segment(run).stat().st_size // 3)
    rotten = segment(run).read_bytes()
    kept = [f"{segment(run).name}.damaged", f"{segment(run).name}.damaged-2"]
    for name in kept:
        (recovered,) = recover_log(log).segments
        assert recovered.kept_copy == name
        assert (log / name).read_bytes() == rotten
        segment(run).write_bytes(rotten)
    monkeypatch.setattr(shutil, "copyfileobj", lambda *_: refuse())
    with pytest.raises(LogError, match="no event that could be read was removed"):
        recover_log(log)
    assert sorted(p.name for p in log.glob("*.damaged*")) == kept
    assert segment(run).read_bytes() == rotten


def test_a_writer_refuses_a_rotten_growing_segment_and_names_recover(run: Commands) -> None:
    active = segment(run).with_name(segment(run).name + ".active")
    active.write_bytes(growing(run.folder / "other", PAYLOADS[:2]))
    segment(run).unlink()
    flip(active, 400)
    said = run("import", "L", "-", stdin=PAYLOADS[0], code=1)
    assert "mapfold log recover L" in said.err
    said = run("log", "recover", "L", code=3)
    assert "original kept as" in said.err
    run("import", "L", "-", stdin=PAYLOADS[0])


def growing(log: Path, payloads: list[bytes]) -> bytes:
    """The bytes of an active segment with one event a commit."""
    from eventsrc.log import ALWAYS, LogWriter

    with LogWriter(log, fsync=ALWAYS) as writer:
        for item in payloads:
            writer.append("tb/detections", item)
        return next(log.glob("*.active")).read_bytes()


def test_no_log_is_one_line(run: Commands) -> None:
    for command in ("info", "cat", "verify", "recover"):
        said = run("log", command, "nowhere", code=2)
        assert said.err.count("\n") == 1
        assert "nowhere" in said.err


def test_two_writers(run: Commands) -> None:
    from eventsrc.log import LogWriter

    with LogWriter(run.folder / "L"):
        for command in (("import", "L", "-"), ("log", "recover", "L")):
            said = run(*command, stdin=PAYLOADS[0], code=1)
            assert "being written by process" in said.err
    run("log", "recover", "L")


def test_a_segment_whose_disk_is_away_does_not_hang_verify(run: Commands) -> None:
    away = run.folder / "unmounted" / segment(run).name
    segment(run).unlink()
    segment(run).symlink_to(away)
    said = run("log", "verify", "L", code=1)
    assert said.err.count("\n") == 1
    assert f"{away.name}: No such file or directory; check" in said.err
