"""Append events and read them back: bytes, times, keys and offsets; the lock; log info."""

import fcntl
import json
import os
import socket
import time
from pathlib import Path

import pytest

from eventsrc.base.errors import LogBusy, LogError, LogNotFound, NotALog
from eventsrc.log import LogReader, LogWriter, verify_log
from eventsrc.log.lock import is_held
from eventsrc.log.sealed_segment import SealedFile
from eventsrc.record.log_info import log_info
from tests.support.fixtures_log import BY_HAND, KEY, envelope, read_log, write_log

ODD_PAYLOADS = [b"", b"\x00", b"\xff\xfe not utf-8", "ε🙂".encode(), b"x" * 100_000]


def test_payloads_times_and_keys_are_read_back_unchanged(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        for index, payload in enumerate(ODD_PAYLOADS):
            key = f"robot/{index % 2}/ε"
            assert writer.append(key, payload, stamp_ns=7 * index, logged_ns=50 - index) == index
    for index, event in enumerate(read_log(log_path)):
        assert event.offset == index
        assert event.key == f"robot/{index % 2}/ε"
        assert event.payload == ODD_PAYLOADS[index]
        assert (event.stamp_ns, event.logged_ns) == (7 * index, 50 - index)


def test_an_event_is_shown_only_once_it_is_synced(log_path: Path) -> None:
    with LogWriter(log_path, fsync=BY_HAND) as writer:
        writer.append(KEY, b"one")
        with LogReader(log_path) as reader:
            assert (writer.next_offset, writer.durable_offset, reader.next_offset) == (1, 0, 0)
            assert writer.sync() == 1
            assert reader.refresh() == 1
            assert [e.payload for e in reader.read()] == [b"one"]


@pytest.mark.parametrize("rotate_events", [1, 3, 1000])
def test_any_range_reads_as_a_slice(log_path: Path, rotate_events: int) -> None:
    payloads = [envelope(i) for i in range(10)]
    with LogWriter(log_path, fsync=BY_HAND, rotate_events=rotate_events) as writer:
        for index, payload in enumerate(payloads):
            writer.append(KEY, payload)
            if index % 2:
                writer.sync()
                writer.commit_if_due()
    for start in range(11):
        for end in (None, *range(12)):
            got = [e.payload for e in read_log(log_path, start, end)]
            assert got == payloads[start:end]


def test_offsets_continue_and_the_id_stays_across_writers(log_path: Path) -> None:
    ids = set()
    for index in range(4):
        with LogWriter(log_path) as writer:
            assert writer.next_offset == index
            writer.append(KEY, envelope(index))
            ids.add(writer.log_id)
    with LogReader(log_path) as reader:
        assert ids == {reader.log_id}
        assert reader.next_offset == 4


def test_an_empty_log_is_a_log(log_path: Path) -> None:
    for _ in range(2):
        with LogWriter(log_path) as writer:
            log_id = writer.log_id
        with LogReader(log_path) as reader:
            assert (reader.log_id, reader.next_offset, list(reader.read())) == (log_id, 0, [])


def test_a_second_writer_is_refused_with_the_name_of_the_holder(log_path: Path) -> None:
    with LogWriter(log_path, clock=lambda: 0), pytest.raises(LogBusy) as caught:
        LogWriter(log_path)
    message = str(caught.value)
    assert str(os.getpid()) in message
    assert socket.gethostname() in message
    assert "1970-01-01T00:00:00+00:00" in message
    LogWriter(log_path).close()


def test_a_deleted_lock_file_does_not_release_the_log(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        writer.append(KEY, b"0")
        writer.sync()
        (log_path / "lock").unlink()
        assert is_held(log_path)
        with pytest.raises(LogBusy, match="is being written by another process"):
            LogWriter(log_path)
        assert is_held(log_path)
    assert not is_held(log_path)
    LogWriter(log_path).close()


def test_asking_whether_a_log_is_held_keeps_no_writer_out(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`log verify` asks whether a log is held, and holds it while it does."""
    LogWriter(log_path).close()
    looking = os.open(log_path / "lock", os.O_RDONLY)
    fcntl.flock(looking, fcntl.LOCK_SH)
    monkeypatch.setattr(time, "sleep", lambda _: fcntl.flock(looking, fcntl.LOCK_UN))
    LogWriter(log_path).close()
    os.close(looking)


def test_no_log_and_not_a_log_are_named(tmp_path: Path) -> None:
    with pytest.raises(LogNotFound):
        LogReader(tmp_path / "absent")
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(NotALog):
        LogReader(tmp_path / "file")
    with pytest.raises(NotALog):
        LogWriter(tmp_path / "file")
    with pytest.raises(NotALog):
        LogReader(tmp_path)
    with pytest.raises(NotALog, match="holds file"):
        LogWriter(tmp_path)


def test_an_unreadable_folder_is_a_one_line_error(tmp_path: Path) -> None:
    for use in (LogReader, LogWriter, verify_log):
        with pytest.raises(LogError, match=r"File name too long; check (its|the folder's) rights"):
            use(tmp_path / ("x" * 300))


def test_a_lock_that_may_not_be_written_is_named(log_path: Path) -> None:
    LogWriter(log_path).close()
    (log_path / "lock").unlink()
    (log_path / "lock").mkdir()
    with pytest.raises(LogError, match=r"log/lock: Is a directory; check its rights"):
        LogWriter(log_path)


def test_info_counts_sealed_and_growing_segments(log_path: Path) -> None:
    write_log(log_path, [envelope(i) for i in range(5)], rotate_events=2)
    with LogWriter(log_path, fsync=BY_HAND) as writer:
        loss = {"publisher": "run", "first": 6, "last": 8, "count": 3, "cause": "keyframe_gap"}
        writer.append("mapfold/loss", json.dumps(loss).encode(), stamp_ns=99, logged_ns=2)
        writer.sync()
        info = log_info(log_path)
        assert info.keys == {"mapfold/loss": 1, KEY: 5}
        assert (info.events, info.lost, info.rejected) == (6, 3, 0)
        assert (info.first_stamp_ns, info.last_stamp_ns) == (0, 4)
        assert (info.first_logged_ns, info.last_logged_ns) == (2, 1004)
        assert [s.sealed for s in info.segments][-1] is False
    assert log_info(log_path).keys == info.keys


def test_reading_by_key_gives_only_that_key(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        for index in range(30):
            writer.append(f"k/{index % 3}", b"%d" % index)
    with LogReader(log_path) as reader:
        assert [e.offset for e in reader.read(keys={"k/1"})] == list(range(1, 30, 3))
        assert list(reader.read(keys={"absent"})) == []


def test_a_segment_whose_opening_was_interrupted_at_once_closes() -> None:
    """As when it is deleted: an error there is printed."""
    SealedFile.__new__(SealedFile).close()
