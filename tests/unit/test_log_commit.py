"""Group commit, rotation, appending in batches, failing disks, and reading beside sealing."""

import contextlib
import errno
import os
import threading
import tracemalloc
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.base.errors import LogError, MisuseError
from eventsrc.log import (
    ALWAYS,
    GROUP_COMMIT,
    NEVER,
    LogReader,
    LogWriter,
    NewEvent,
    parse_fsync,
    verify_log,
)
from eventsrc.log import active_segment as _active
from eventsrc.log import sealer as _sealer
from eventsrc.log.active_segment import ActiveSegment
from eventsrc.log.durable_files import FsyncPolicy
from eventsrc.log.seal import SegmentPlan, seal
from eventsrc.record.log_info import log_info
from tests.support.fixtures_log import BY_HAND, KEY, read_log
from tests.support.thorough import examples

TIMEOUT_S = 30
FOUR = FsyncPolicy(interval_ns=10**18, max_events=4)


def new(*payloads: bytes) -> list[NewEvent]:
    """Events to append."""
    return [NewEvent(KEY, payload, 10 + n, n) for n, payload in enumerate(payloads)]


def test_parse_fsync() -> None:
    assert parse_fsync("always") == ALWAYS
    assert parse_fsync("never") == NEVER
    assert parse_fsync("50ms") == GROUP_COMMIT
    assert parse_fsync("200ms").interval_ns == 200_000_000
    for text in ("", "0ms", "ms", "-5ms", "1.5ms", "50", "50s", "sometimes", "9999999ms"):
        with pytest.raises(MisuseError, match="50ms"):
            parse_fsync(text)


@pytest.fixture
def syncs(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """One entry for each data sync."""
    done: list[int] = []
    real = os.fdatasync

    def counted(fd: int) -> None:
        done.append(fd)
        real(fd)

    monkeypatch.setattr(os, "fdatasync", counted)
    return done


@pytest.mark.parametrize(
    ("policy", "durable", "synced"),
    [
        (ALWAYS, 10, 10),
        (FsyncPolicy(interval_ns=10**18, max_events=4), 8, 2),
        (FsyncPolicy(interval_ns=10**18, max_bytes=1), 10, 10),
        (FsyncPolicy(interval_ns=10**18, max_events=5, syncs=False), 10, 0),
        (BY_HAND, 0, 0),
    ],
)
def test_commits_and_syncs_of_each_policy(
    log_path: Path, syncs: list[int], policy: FsyncPolicy, durable: int, synced: int
) -> None:
    with LogWriter(log_path, fsync=policy) as writer:
        before = len(syncs)
        for _ in range(10):
            writer.append(KEY, b"x")
        assert writer.durable_offset == durable
        assert len(syncs) - before == synced


def test_time_makes_a_commit_due_without_another_event(log_path: Path) -> None:
    policy = FsyncPolicy(interval_ns=20_000_000)
    idle = threading.Event()
    with LogWriter(log_path, fsync=policy) as writer:
        assert not writer.commit_if_due()
        writer.append(KEY, b"x")
        for _ in range(1000):
            if writer.commit_if_due():
                break
            idle.wait(0.001)
        assert writer.durable_offset == 1
        assert not writer.commit_if_due()


@pytest.mark.parametrize(
    "limits", [{"rotate_bytes": 1}, {"rotate_events": 1}, {"rotate_seconds": 0.0}]
)
def test_each_limit_causes_a_rotation(log_path: Path, limits: dict[str, Any]) -> None:
    with LogWriter(log_path, fsync=ALWAYS, **limits) as writer:
        for _ in range(3):
            writer.append(KEY, b"x")
    bases = sorted(int(p.name[:20]) for p in log_path.glob("*.mcap"))
    assert bases == [0, 1, 2]


def test_age_rotates_an_idle_log_but_never_an_empty_segment(log_path: Path) -> None:
    with LogWriter(log_path, fsync=BY_HAND, rotate_seconds=0.0) as writer:
        writer.commit_if_due()
        assert len(list(log_path.glob("*.active"))) == 1
        writer.append(KEY, b"x")
        writer.sync()
        writer.commit_if_due()
        writer.commit_if_due()
        assert writer._active.base == 1


def hold(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Sealing waits for this event."""
    may_seal = threading.Event()
    real: Callable[..., str] = seal

    def held(*args: Any) -> str:
        assert may_seal.wait(TIMEOUT_S)
        return real(*args)

    monkeypatch.setattr(_sealer, "seal", held)
    return may_seal


def test_recording_and_reading_go_on_while_segments_are_sealed(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_seal = hold(monkeypatch)
    with LogWriter(log_path, fsync=ALWAYS, rotate_events=2) as writer:
        for number in range(7):
            writer.append(KEY, b"%d" % number)
        assert not list(log_path.glob("*.mcap"))
        assert len(list(log_path.glob("*.active"))) == 4
        assert [e.payload for e in read_log(log_path)] == [b"%d" % n for n in range(7)]
        with LogReader(log_path) as reader:
            events = reader.read()
            first = next(events)
            may_seal.set()
            writer.close()
            assert [first, *events] == read_log(log_path)
    assert not list(log_path.glob("*.active"))


def test_a_segment_sealed_while_a_reader_lists_the_folder_is_found(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reader checks one name and then the other; sealing renames the file in between."""
    real_seal: Callable[..., str] = seal
    begun, may_seal = threading.Event(), threading.Event()

    def held_at_two(plan: SegmentPlan, bodies: Iterable[bytes]) -> str:
        if plan.base == 2:
            begun.set()
            assert may_seal.wait(TIMEOUT_S)
        return real_seal(plan, bodies)

    monkeypatch.setattr(_sealer, "seal", held_at_two)
    real_exists = Path.exists

    def slow(path: Path) -> bool:
        there = real_exists(path)
        if path.name == f"{2:020d}.mcap" and not may_seal.is_set():
            may_seal.set()
            writer._sealer.finish()
        return there

    with (
        LogWriter(log_path, fsync=ALWAYS, rotate_events=1) as writer,
        LogReader(log_path) as reader,
    ):
        for number in range(3):
            writer.append(KEY, b"%d" % number)
        assert begun.wait(TIMEOUT_S)
        monkeypatch.setattr(Path, "exists", slow)
        assert reader.refresh() == 3
        assert may_seal.is_set()


def test_a_disk_that_fails_to_sync_ends_the_writer(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    writer.append(KEY, b"safe")
    writer.sync()
    writer.append(KEY, b"unsure")

    def broken(fd: int) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fdatasync", broken)
        with pytest.raises(LogError, match="Input/output error"):
            writer.sync()
    with pytest.raises(LogError, match="Input/output error"):
        writer.sync()
    assert [e.payload for e in read_log(log_path)] == [b"safe"]
    with pytest.raises(LogError):
        writer.close()
    with LogWriter(log_path) as again:
        assert again.next_offset == 1


def test_after_an_interrupted_write_the_writer_refuses_further_work(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Readers stop at the torn chunk and would not see what is written behind it."""
    writer = LogWriter(log_path, fsync=BY_HAND)
    writer.append(KEY, b"0")
    writer.sync()

    def interrupted(fd: int, data: bytes) -> None:
        os.write(fd, data[:20])
        raise KeyboardInterrupt

    writer.append(KEY, b"1")
    with monkeypatch.context() as patch:
        patch.setattr(_active, "write_all", interrupted)
        with pytest.raises(KeyboardInterrupt):
            writer.sync()
    with pytest.raises(LogError, match="interrupted: 1 events from offset 1 on could not be"):
        writer.append(KEY, b"2")
    with pytest.raises(LogError, match="interrupted"):
        writer.close()
    assert [e.payload for e in read_log(log_path)] == [b"0"]
    with LogWriter(log_path) as again:
        assert (again.restart.torn_bytes, again.append(KEY, b"1")) == (0, 1)


def test_times_out_of_bounds_are_refused(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        for times in ({"stamp_ns": -1}, {"logged_ns": 2**63}):
            with pytest.raises(LogError, match="nanoseconds"):
                writer.append(KEY, b"x", **times)
        assert writer.next_offset == 0


def test_times_out_of_bounds_refuse_the_whole_batch(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        with pytest.raises(LogError, match="nanoseconds"):
            writer.append_all([*new(b"good"), NewEvent(KEY, b"bad", -1, 0)])
        assert writer.next_offset == 0


def test_with_fsync_always_each_append_is_synced_and_visible(log_path: Path) -> None:
    with LogWriter(log_path, fsync=ALWAYS) as writer:
        for number in range(1, 4):
            writer.append(KEY, b"x")
            assert writer.durable_offset == number
            with LogReader(log_path) as reader:
                assert reader.next_offset == number


@settings(max_examples=examples(30), deadline=None)
@given(
    batches=st.lists(st.lists(st.binary(max_size=20), max_size=30), max_size=8),
    policy=st.sampled_from([ALWAYS, FOUR, GROUP_COMMIT, BY_HAND]),
    rotate_events=st.sampled_from([1, 7, 1000]),
)
def test_batches_and_single_appends_make_the_same_log_with_at_most_one_group_unsynced(
    batches: list[list[bytes]],
    policy: FsyncPolicy,
    rotate_events: int,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("logs")
    with LogWriter(
        folder / "batches", fsync=policy, rotate_events=rotate_events, clock=lambda: 7
    ) as writer:
        for batch in batches:
            first = writer.next_offset
            assert writer.append_all(new(*batch)) == first
            assert writer.next_offset == first + len(batch)
            assert writer.next_offset - writer.durable_offset < policy.max_events
    with LogWriter(folder / "single", fsync=policy, clock=lambda: 7) as writer:
        for batch in batches:
            for event in new(*batch):
                writer.append(
                    KEY, event.payload, stamp_ns=event.stamp_ns, logged_ns=event.logged_ns
                )
    events = read_log(folder / "batches")
    assert events == read_log(folder / "single")
    assert [e.payload for e in events] == [payload for batch in batches for payload in batch]


def test_a_next_segment_that_cannot_be_made_ends_the_writer(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = LogWriter(log_path, fsync=FOUR, rotate_events=4)
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


def test_the_end_of_a_long_log_is_read_without_the_rest(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with LogWriter(log_path, rotate_bytes=2**20) as writer:
        for number in range(3000):
            writer.append(KEY, b"%04d" % number + b"x" * 4000)
    total = 3000 * 4004
    read = 0
    real = os.pread

    def counted(fd: int, length: int, at: int) -> bytes:
        nonlocal read
        read += length
        return real(fd, length, at)

    monkeypatch.setattr(os, "pread", counted)
    with LogReader(log_path) as reader:
        last = list(reader.read(reader.next_offset - 10))
    assert [e.payload[:4] for e in last] == [b"%04d" % n for n in range(2990, 3000)]
    assert read < total / 20


def test_memory_does_not_grow_with_the_log(log_path: Path) -> None:
    with LogWriter(log_path, rotate_bytes=4 * 2**20) as writer:
        for number in range(5000):
            writer.append(KEY, os.urandom(2000) + b"%d" % number)
    tracemalloc.start()
    with LogReader(log_path) as reader:
        count = sum(1 for _ in reader.read())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 5000
    assert peak < 5 * 2**20, f"{peak} bytes to read 10 MB"


def test_a_clock_that_is_set_back_changes_no_order(log_path: Path) -> None:
    now_ns = 10**9
    with LogWriter(log_path, clock=lambda: now_ns, fsync=ALWAYS, rotate_events=3) as writer:
        for number, at_ns in enumerate([50, 40, 30, 10**9, 1, 2, 3, 0]):
            now_ns = at_ns
            writer.append(KEY, b"%d" % number)
    events = read_log(log_path)
    assert [e.payload for e in events] == [b"%d" % n for n in range(8)]
    assert [e.logged_ns for e in events] == [50, 40, 30, 10**9, 1, 2, 3, 0]
    (finding,) = verify_log(log_path).findings[-1:]
    info = log_info(log_path)
    assert (info.first_logged_ns, info.last_logged_ns) == (0, 10**9)
    assert (finding.kind, finding.first_offset) == ("time", 1)
