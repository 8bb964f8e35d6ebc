"""Read errors of the disk are handled like damaged bytes."""

import os
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged
from eventsrc.log import FsyncPolicy, LogWriter, recover_log, verify_log
from tests.support.fixtures_log import KEY, read_log, read_with_gaps

BAD = range(1_500_000, 1_504_096)
"""The bytes of the segment that cannot be read: one page, in its second chunk."""


EVERY_110 = FsyncPolicy(max_events=110, max_bytes=2**30, interval_ns=10**12)
"""So that a chunk holds 110 events however slow the machine is."""


@pytest.fixture
def failing(log_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of one segment with a bad page."""
    with LogWriter(log_path, fsync=EVERY_110) as writer:
        for number in range(300):
            writer.append(KEY, b"%04d" % number + os.urandom(10_000))
    bad_inode = next(log_path.glob("*.mcap")).stat().st_ino
    real = os.pread

    def failing(fd: int, length: int, at: int) -> bytes:
        if os.fstat(fd).st_ino == bad_inode and at < BAD.stop and at + length > BAD.start:
            raise OSError(5, "Input/output error")
        return real(fd, length, at)

    monkeypatch.setattr(os, "pread", failing)
    return log_path


def test_reading_names_the_offsets(failing: Path) -> None:
    with pytest.raises(LogDamaged, match="Input/output error"):
        read_log(failing)
    shown, gaps = read_with_gaps(failing)
    assert len(shown) + len(gaps) == 300
    assert len(gaps) == 110


def test_verify_and_recover_keep_the_rest(failing: Path) -> None:
    _, gaps = read_with_gaps(failing)
    assert {"gap"} <= {f.kind for f in verify_log(failing).findings}
    (segment,) = recover_log(failing).segments
    assert segment.lost_events == len(gaps)
    events = read_log(failing)
    assert [e.payload[:4] == b"%04d" % e.offset for e in events] == [
        offset not in gaps for offset in range(300)
    ]
