"""Work that is done while a commit waits for the disk changes nothing about the commit."""

import errno
import os
import threading
from pathlib import Path

import pytest

from eventsrc.base.errors import LogError
from eventsrc.log import ALWAYS, LogWriter, active_segment
from tests.support.fixtures_log import BY_HAND, KEY, read_log

TIMEOUT_S = 30


class Disk:
    """Each sync waits for ``go_on``, which the work may set, and fails with ``error`` if set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.go_on = threading.Event()
        self.error: OSError | None = None
        real = active_segment.sync_file

        def sync_file(fd: int) -> None:
            assert self.go_on.wait(TIMEOUT_S)
            if self.error is not None:
                raise self.error
            real(fd)

        monkeypatch.setattr(active_segment, "sync_file", sync_file)


def test_work_is_called_until_the_sync_is_done_and_the_commit_waits_for_its_end(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, int]] = []
    ended = True

    with LogWriter(log_path, fsync=BY_HAND) as writer:
        disk = Disk(monkeypatch)

        def work() -> bool:
            nonlocal ended
            ended = False
            seen.append((writer.next_offset, writer.durable_offset))
            if len(seen) == 5:
                disk.go_on.set()
            ended = True
            return True

        writer.work_while_syncing(work)
        writer.append(KEY, b"0")
        writer.append(KEY, b"1")
        assert not seen
        assert writer.sync() == 2
        assert ended
        count = len(seen)
        assert count >= 5
        assert set(seen) == {(2, 0)}
        writer.work_while_syncing(None)
        writer.append(KEY, b"2")
        writer.sync()
        assert len(seen) == count
    assert [e.payload for e in read_log(log_path)] == [b"0", b"1", b"2"]


def test_work_that_has_nothing_to_do_is_not_called_again_in_that_commit(log_path: Path) -> None:
    calls = []
    with LogWriter(log_path, fsync=ALWAYS) as writer:
        writer.work_while_syncing(lambda: bool(calls.append(1)))
        for number in range(3):
            writer.append(KEY, b"%d" % number)
            assert len(calls) <= number + 1
    assert [e.payload for e in read_log(log_path)] == [b"0", b"1", b"2"]


def test_a_failing_sync_fails_the_commit_whatever_the_work(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(monkeypatch)
    disk.go_on.set()
    writer = LogWriter(log_path, fsync=BY_HAND)
    writer.work_while_syncing(lambda: True)
    writer.append(KEY, b"0")
    writer.sync()
    disk.error = OSError(errno.EIO, os.strerror(errno.EIO))
    writer.append(KEY, b"1")
    with pytest.raises(LogError, match="1 events from offset 1 on could not be written"):
        writer.sync()
    assert writer.durable_offset == 1
    with pytest.raises(LogError):
        writer.append(KEY, b"2")
    with pytest.raises(LogError):
        writer.close()
    assert [e.payload for e in read_log(log_path)] == [b"0"]


def test_an_error_in_the_work_is_raised_and_its_group_is_not_recorded(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    writer.append(KEY, b"0")
    writer.sync()
    disk = Disk(monkeypatch)

    def work() -> bool:
        disk.go_on.set()
        raise ZeroDivisionError("in the work")

    writer.work_while_syncing(work)
    writer.append(KEY, b"1")
    with pytest.raises(ZeroDivisionError):
        writer.sync()
    assert writer.durable_offset == 1
    with pytest.raises(LogError, match="interrupted"):
        writer.append(KEY, b"2")
    with pytest.raises(LogError):
        writer.close()
    assert [e.payload for e in read_log(log_path)] == [b"0"]
