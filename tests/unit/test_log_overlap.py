"""Committing beside the thread that appends: the same log, and nothing counts before its sync."""

import contextlib
import errno
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.errors import LogError
from eventsrc.log import ALWAYS, GROUP_COMMIT, LogReader, LogWriter, NewEvent
from eventsrc.log.active_segment import ActiveSegment
from eventsrc.log.commit_thread import SLACK
from eventsrc.log.durable_files import FsyncPolicy
from tests.fixtures_log import BY_HAND, KEY, read_log

TIMEOUT_S = 30
FOUR = FsyncPolicy(interval_ns=10**18, max_events=4)


def new(*payloads: bytes) -> list[NewEvent]:
    """Events to append."""
    return [NewEvent(KEY, payload, 10 + n, n) for n, payload in enumerate(payloads)]


class Disk:
    """Data syncs that wait until they are let through, one by one."""

    def __init__(self, real: Callable[[int], None]) -> None:
        self._real = real
        self.asked = threading.Semaphore(0)
        self.let_through = threading.Semaphore(0)
        self.broken = False

    def fdatasync(self, fd: int) -> None:
        self.asked.release()
        assert self.let_through.acquire(timeout=TIMEOUT_S)
        if self.broken:
            raise OSError(5, "Input/output error")
        self._real(fd)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    """Slow from the first commit on; a new log's head has been written by then."""
    return Disk(os.fdatasync)


def slow(disk: Disk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fdatasync", disk.fdatasync)


def test_appending_goes_on_during_a_sync_and_nothing_counts_before_its_end(
    log_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    with LogWriter(log_path, fsync=FOUR, overlap=True) as writer:
        slow(disk, monkeypatch)
        writer.append_all(new(b"a", b"b", b"c", b"d"))
        assert disk.asked.acquire(timeout=TIMEOUT_S)
        writer.append_all(new(b"e", b"f", b"g", b"h", b"i"))
        assert (writer.next_offset, writer.durable_offset) == (9, 0)
        assert read_log(log_path) == []
        disk.let_through.release(2)
        assert writer.sync() == 9
        assert [e.payload for e in read_log(log_path)] == [b"%c" % c for c in b"abcdefghi"]
        disk.let_through.release(9)


def test_a_disk_that_does_not_keep_up_makes_the_writer_wait(
    log_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = FOUR.max_events * SLACK
    with LogWriter(log_path, fsync=FOUR, overlap=True) as writer:
        slow(disk, monkeypatch)
        writer.append_all(new(*[b"x"] * 4))
        writer.append_all(new(*[b"x"] * (most - 1)))
        assert writer.next_offset == 4 + most - 1
        late = threading.Thread(target=writer.append_all, args=(new(b"one too many"),))
        late.start()
        late.join(0.05)
        assert late.is_alive()
        disk.let_through.release(99)
        late.join(TIMEOUT_S)
        assert not late.is_alive()
    assert len(read_log(log_path)) == 4 + most


def test_a_rotation_stops_nobody_and_nothing_counts_before_its_sync(
    log_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    with LogWriter(log_path, fsync=FOUR, overlap=True, rotate_events=3) as writer:
        writer.append_all(new(b"a", b"b", b"c"))
        assert writer.sync() == 3
        slow(disk, monkeypatch)
        writer.append_all(new(b"d"))  # into the full segment, which ends with it
        assert disk.asked.acquire(timeout=TIMEOUT_S)
        writer.append_all(new(b"e", b"f"))
        assert (writer.next_offset, writer.durable_offset) == (6, 3)
        assert [e.payload for e in read_log(log_path)] == [b"a", b"b", b"c"]
        disk.let_through.release(99)
        assert writer.sync() == 6
        assert [e.payload for e in read_log(log_path)] == [b"%c" % c for c in b"abcdef"]
    assert [int(path.stem) for path in sorted(log_path.glob("*.mcap"))] == [0, 4]


@pytest.mark.parametrize("overlap", [False, True])
def test_a_next_segment_that_cannot_be_made_ends_the_writer(
    log_path: Path, overlap: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = LogWriter(log_path, fsync=FOUR, overlap=overlap, rotate_events=4)
    writer.append_all(new(b"s", b"a", b"f"))
    with monkeypatch.context() as patch:
        patch.setattr(ActiveSegment, "create", refuse)
        with pytest.raises(LogError, match=r"no new segment at offset \d+: No space left"):
            append_for_ever(writer)
        with pytest.raises(LogError, match="no new segment"):
            writer.append(KEY, b"never")
        kept = writer.durable_offset
        assert kept >= 4
        with contextlib.suppress(LogError):
            writer.close()
    assert len(read_log(log_path)) == kept
    with LogWriter(log_path) as again:
        assert again.next_offset == kept


def refuse(_: ActiveSegment) -> None:
    """A disk that is full."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def append_for_ever(writer: LogWriter) -> None:
    """Until the writer refuses."""
    while True:
        writer.append_all(new(b"unsure"))


def test_a_disk_that_fails_in_the_other_thread_ends_the_writer(
    log_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = LogWriter(log_path, fsync=FOUR, overlap=True)
    writer.append_all(new(b"s", b"a", b"f", b"e"))
    assert writer.sync() == 4
    with monkeypatch.context() as patch:
        slow(disk, patch)
        disk.broken = True
        disk.let_through.release(99)
        with pytest.raises(LogError, match="from offset 4 on could not be written"):
            append_for_ever(writer)
        with pytest.raises(LogError, match="Input/output error"):
            writer.commit_if_due()
    assert writer.durable_offset == 4
    with pytest.raises(LogError):
        writer.close()
    assert [e.payload for e in read_log(log_path)] == [b"s", b"a", b"f", b"e"]
    with LogWriter(log_path) as again:
        assert again.next_offset == 4


def test_always_means_always(log_path: Path) -> None:
    with LogWriter(log_path, fsync=ALWAYS, overlap=True) as writer:
        for number in range(1, 4):
            writer.append(KEY, b"x")
            assert writer.durable_offset == number
            with LogReader(log_path) as reader:
                assert reader.next_offset == number


@settings(max_examples=30, deadline=None)
@given(
    batches=st.lists(st.lists(st.binary(max_size=20), max_size=30), max_size=8),
    policy=st.sampled_from([ALWAYS, FOUR, GROUP_COMMIT, BY_HAND]),
    rotate_events=st.sampled_from([1, 7, 1000]),
)
def test_batches_or_one_by_one_overlapped_or_not_it_is_the_same_log(
    batches: list[list[bytes]],
    policy: FsyncPolicy,
    rotate_events: int,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("logs")
    shown = []
    for overlap in (False, True):
        path = folder / str(overlap)
        with LogWriter(
            path, fsync=policy, rotate_events=rotate_events, overlap=overlap, clock=lambda: 7
        ) as writer:
            for batch in batches:
                first = writer.next_offset
                assert writer.append_all(new(*batch)) == first
                assert writer.next_offset == first + len(batch)
        shown.append(read_log(path))
    with LogWriter(folder / "single", fsync=policy, clock=lambda: 7) as writer:
        for batch in batches:
            for event in new(*batch):
                writer.append(
                    KEY, event.payload, stamp_ns=event.stamp_ns, logged_ns=event.logged_ns
                )
    assert shown[0] == shown[1] == read_log(folder / "single")
    assert [e.payload for e in shown[0]] == [payload for batch in batches for payload in batch]


def test_times_out_of_bounds_refuse_the_whole_batch(log_path: Path) -> None:
    with LogWriter(log_path, overlap=True) as writer:
        with pytest.raises(LogError, match="nanoseconds"):
            writer.append_all([*new(b"good"), NewEvent(KEY, b"bad", -1, 0)])
        assert writer.next_offset == 0
