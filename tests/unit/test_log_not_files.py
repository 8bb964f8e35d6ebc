"""What has the name of a segment, or of the lock, and is no file: nothing waits for it, every
command says what it is, and recovery sets it aside."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import ALWAYS, LogWriter, recover_log, verify_log
from eventsrc.log.format import LOCK
from eventsrc.record.log_info import log_info
from tests.support.fixtures_log import envelope, read_log, write_log

EACH = 2


def folder(path: Path) -> None:
    path.mkdir()
    (path / "in it").touch()


def pipe(path: Path) -> None:
    os.mkfifo(path)


def link_to_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.fixture
def log(log_path: Path) -> Path:
    """A log of three segments."""
    write_log(log_path, [envelope(n) for n in range(3 * EACH)], fsync=ALWAYS, rotate_events=EACH)
    return log_path


@pytest.mark.timeout(30)
@pytest.mark.parametrize("base", [0, EACH, 2 * EACH])
@pytest.mark.parametrize("make", [folder, pipe, link_to_device])
def test_a_segment_that_is_no_file_is_missing(
    log: Path, make: Callable[[Path], None], base: int
) -> None:
    segment = log / f"{base:020d}.mcap"
    segment.unlink()
    make(segment)
    findings = verify_log(log).findings
    assert ("crc", segment.name) in [(f.kind, f.segment) for f in findings]
    assert [(f.first_offset, f.last_offset) for f in findings if f.kind == "gap"] == [
        (base, base + EACH - 1)
    ]
    with pytest.raises(LogDamaged, match=f"offsets {base} to {base + EACH - 1}"):
        read_log(log)
    (moved,) = recover_log(log).moved
    assert moved.now == f"{segment.name}.damaged"
    assert [e.offset for e in read_log(log) if e.key == LOSS_KEY] == [base, base + 1]
    assert {f.kind for f in verify_log(log).findings} == {"loss"}
    with LogWriter(log) as writer:
        assert writer.next_offset == 3 * EACH


@pytest.mark.parametrize("to", ["nowhere", f"{EACH:020d}.mcap"])
def test_nothing_is_changed_while_the_disk_of_a_segment_is_away(log: Path, to: str) -> None:
    segment = log / f"{EACH:020d}.mcap"
    away = segment.rename(log.parent / "away")
    segment.symlink_to(to)
    for use in (verify_log, recover_log):
        with pytest.raises(LogError, match=segment.name):
            use(log)
    segment.unlink()
    segment.symlink_to(away)
    assert len(read_log(log)) == 3 * EACH
    assert not recover_log(log).findings


@pytest.mark.timeout(30)
@pytest.mark.parametrize("make", [folder, pipe])
def test_a_lock_that_is_no_file_is_named(log: Path, make: Callable[[Path], None]) -> None:
    (log / LOCK).unlink()
    make(log / LOCK)
    assert verify_log(log).findings == ()
    for use in (LogWriter, recover_log):
        with pytest.raises(LogError, match="/lock"):
            use(log)


def test_info_says_which_segments_were_deleted(log: Path) -> None:
    (log / f"{EACH:020d}.mcap").unlink()
    said: list[str] = []
    log_info(log, note=said.append)
    (line,) = said
    assert f"offsets {EACH} to {2 * EACH - 1} are missing" in line
    assert "mapfold log verify" in line


def test_a_segment_that_is_no_mcap_file_is_named_with_its_offsets(log: Path) -> None:
    (log / f"{EACH:020d}.mcap").write_bytes(bytes(5_000))
    with pytest.raises(LogDamaged, match=rf"offsets {EACH} to {2 * EACH - 1} cannot be read"):
        read_log(log)
