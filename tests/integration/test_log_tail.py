"""A tail sees every event once and in order, across rotations, from another process too."""

import queue
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged, LogError, LogNotFound
from eventsrc.log import Event, LogReader, LogWriter, follow
from eventsrc.log.format import SEALED_END
from eventsrc.log.mcap_records import MARK_BYTES
from scripts.programs.chaos.log_writer import payload_at
from tests.support.fixtures_log import BY_HAND, KEY, flip, write_log

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 60


@contextmanager
def tail(path: Path, start: int = 0) -> Iterator["queue.Queue[Event | None]"]:
    """A queue that a tail in a thread of its own fills; None when it has caught up."""
    got: queue.Queue[Event | None] = queue.Queue()
    stop = threading.Event()

    def run() -> None:
        for event in follow(path, start, stop=stop):
            got.put(event)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield got
    finally:
        stop.set()
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()


def next_event(got: "queue.Queue[Event | None]") -> Event:
    deadline = time.monotonic() + TIMEOUT_S
    while (event := got.get(timeout=deadline - time.monotonic())) is None:
        pass
    return event


def test_rotation_under_load(log_path: Path) -> None:
    total = 3000
    with (
        LogWriter(log_path, rotate_events=64) as writer,
        tail(log_path) as first,
        tail(log_path, start=total // 2) as second,
    ):
        for offset in range(total):
            writer.append(KEY, payload_at(offset))
        writer.sync()
        for start, got in ((0, first), (total // 2, second)):
            for offset in range(start, total):
                event = next_event(got)
                assert (event.offset, event.payload) == (offset, payload_at(offset))


@pytest.mark.slow
def test_a_tail_of_another_process(log_path: Path) -> None:
    with LogWriter(log_path):
        pass  # so that there is a log to follow
    command = [sys.executable, "-m", "scripts.programs.chaos.log_writer", str(log_path), "5ms"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        try:
            with tail(log_path) as got:
                for offset in range(5000):
                    event = next_event(got)
                    assert (event.offset, event.payload) == (offset, payload_at(offset))
        finally:
            process.kill()


def test_a_tail_continues_across_a_restart(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        writer.append(KEY, b"0")
    with tail(log_path) as got:
        assert next_event(got).payload == b"0"
        for number in range(1, 4):
            with LogWriter(log_path) as writer:
                writer.append(KEY, b"%d" % number)
            assert next_event(got).payload == b"%d" % number


def test_unsynced_events_are_not_shown(log_path: Path) -> None:
    with LogWriter(log_path, fsync=BY_HAND) as writer, tail(log_path) as got:
        writer.append(KEY, b"waiting")
        assert got.get(timeout=TIMEOUT_S) is None
        assert got.get(timeout=TIMEOUT_S) is None
        writer.sync()
        assert next_event(got).payload == b"waiting"


def test_a_tail_stops_at_unreadable_events(log_path: Path) -> None:
    stop = threading.Event()
    writer = LogWriter(log_path, fsync=BY_HAND)
    writer.append(KEY, b"good")
    writer.sync()
    size = next(log_path.glob("*.active")).stat().st_size
    writer.append(KEY, b"rotten")
    writer.sync()
    with next(log_path.glob("*.active")).open("r+b") as file:
        file.seek(size + 60)
        file.write(b"\xff")
    events = follow(log_path, 0, stop=stop)
    first = next(events)
    assert first is not None
    assert first.payload == b"good"
    with pytest.raises(LogDamaged, match="offsets 1 to 1"):
        next(events)
    with pytest.raises(LogError, match="log recover"):
        writer.close()


@pytest.mark.parametrize("at", [3, -10], ids=["chunk head", "commit mark"])
@pytest.mark.parametrize("behind", ["same segment", "next segment"])
def test_a_waiting_tail_detects_damage(log_path: Path, at: int, behind: str) -> None:
    stop = threading.Event()
    rotate_events = 2 if behind == "next segment" else 100
    writer = LogWriter(log_path, fsync=BY_HAND, rotate_events=rotate_events)
    writer._sealer.submit = lambda *_, **__: None  # type: ignore[method-assign]
    active = next(log_path.glob("*.active"))
    ends = []
    for number in range(3):
        writer.append(KEY, b"%d" % number)
        writer.sync()
        ends.append(active.stat().st_size)
        writer.commit_if_due()
    flip(active, ends[0] + at if at > 0 else ends[1] + at)
    events = follow(log_path, 0, stop=stop, poll_s=0.0)
    first = next(events)
    assert first is not None
    assert first.payload == b"0"
    with pytest.raises(LogDamaged, match="offsets 1 to"):
        list(events)
    writer._active.close()
    writer._lock.release()


def test_a_tail_of_a_log_that_is_gone_ends(log_path: Path) -> None:
    write_log(log_path, [b"0"])
    events = follow(log_path, 0, stop=threading.Event(), poll_s=0.0)
    assert next(events) is not None
    shutil.rmtree(log_path)
    with pytest.raises(LogNotFound, match="is gone"):
        list(events)


def test_a_tail_reads_events_that_recovery_found_behind_the_last_mark(log_path: Path) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    for payload in (b"zero", b"one"):
        writer.append(KEY, payload)
        writer.sync()
    active = next(log_path.glob("*.active"))
    torn = active.read_bytes()[:-MARK_BYTES]
    writer.close()
    next(log_path.glob("*.mcap")).unlink()
    (log_path / SEALED_END).unlink()
    active.write_bytes(torn)  # as after a kill between the sync and the mark
    with tail(log_path) as got:
        assert next_event(got).payload == b"zero"
        with LogWriter(log_path) as writer:
            writer.append(KEY, b"two")
        assert [next_event(got).payload for _ in range(2)] == [b"one", b"two"]


def test_a_reader_of_many_segments_keeps_the_growing_one_up_to_date(log_path: Path) -> None:
    with LogWriter(log_path, fsync=BY_HAND, rotate_events=2) as writer:

        def record(count: int) -> None:
            for _ in range(count):
                writer.append(KEY, payload_at(writer.next_offset))
                writer.sync()

        record(40)
        with LogReader(log_path) as reader:
            assert len(reader.segments) > 10
            assert len(list(reader.read())) == 40  # more segments than a reader keeps open
            for offset in range(40, 49):
                record(1)
                assert reader.refresh() == offset + 1
                assert [e.offset for e in reader.read(offset - 1)] == [offset - 1, offset]
