"""Segments that a killed writer left are finished at the next start and sealed in background."""

import errno
import os
import threading
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.log import ALWAYS, LogReader, LogWriter, recover_log, verify_log
from eventsrc.log import mcap_records as _mcap
from eventsrc.log import sealer as _sealer
from eventsrc.log.active_segment import ActiveSegment
from eventsrc.log.format import ACTIVE, SEALED, segment_path
from tests.support.fixtures_log import BY_HAND, KEY, read_log

TIMEOUT_S = 30


def killed(path: Path, events: int, rotate_events: int) -> None:
    """Leave finished segments that are not sealed, and a growing one."""
    writer = LogWriter(path, fsync=ALWAYS, rotate_events=rotate_events)
    writer._sealer.submit = lambda *_, **__: None  # type: ignore[method-assign]
    for number in range(events):
        writer.append(KEY, b"%d" % number)
    writer._active.close()
    writer._lock.release()


class Held:
    """Sealing that waits until it may begin."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.may_begin = threading.Event()
        real = _sealer.seal

        def seal(*args: object) -> str:
            assert self.may_begin.wait(TIMEOUT_S)
            return real(*args)  # type: ignore[arg-type]

        monkeypatch.setattr(_sealer, "seal", seal)


def payloads(path: Path) -> list[bytes]:
    return [event.payload for event in read_log(path)]


def test_a_writer_does_not_wait_for_the_sealing_of_left_over_segments(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed(log_path, 8, rotate_events=3)
    held = Held(monkeypatch)
    with LogWriter(log_path, fsync=ALWAYS) as writer:
        assert (writer.restart.recovered_segments, writer.restart.recovered_events) == (3, 8)
        assert writer.append(KEY, b"8") == 8
        assert writer.sealing.waiting == 3
        assert payloads(log_path) == [b"%d" % n for n in range(9)]
        held.may_begin.set()
    assert payloads(log_path) == [b"%d" % n for n in range(9)]
    assert not list(log_path.glob("*.active"))
    assert {f.kind for f in verify_log(log_path).findings} == {"schema"}


def test_a_second_kill_before_sealing_loses_nothing(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed(log_path, 5, rotate_events=2)
    with monkeypatch.context() as patch:
        patch.setattr(_sealer.Sealer, "submit", lambda *_, **__: None)
        again = LogWriter(log_path, fsync=ALWAYS)
        again.append(KEY, b"5")
        again._active.close()
        again._lock.release()
    with LogWriter(log_path) as writer:
        assert writer.restart.recovered_segments == 4
        assert writer.next_offset == 6
    assert payloads(log_path) == [b"%d" % n for n in range(6)]
    assert {f.kind for f in verify_log(log_path).findings} == {"schema"}


def test_a_torn_end_is_cut_off(log_path: Path) -> None:
    killed(log_path, 3, rotate_events=100)
    active = segment_path(log_path, 0, ACTIVE)
    whole = active.read_bytes()
    with active.open("ab") as file:
        file.write(whole[-70:-35])
    with LogWriter(log_path) as writer:
        assert writer.restart.torn_bytes == 35
        assert writer.next_offset == 3
    assert payloads(log_path) == [b"0", b"1", b"2"]


def test_a_chunk_without_its_mark_is_kept_and_shown_before_it_is_sealed(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed(log_path, 3, rotate_events=100)
    active = segment_path(log_path, 0, ACTIVE)
    marked = active.read_bytes()
    active.write_bytes(marked[: -_mcap.MARK_BYTES])
    assert payloads(log_path) == [b"0", b"1"]
    held = Held(monkeypatch)
    with LogWriter(log_path, fsync=ALWAYS) as writer:
        assert active.read_bytes() == marked
        writer.append(KEY, b"3")
        assert payloads(log_path) == [b"0", b"1", b"2", b"3"]
        held.may_begin.set()


def test_after_a_damaged_mark_all_left_over_segments_are_sealed_at_once(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed(log_path, 5, rotate_events=3)
    active = segment_path(log_path, 0, ACTIVE)
    data = bytearray(active.read_bytes())
    data[data.index(_mcap.MARK_PATTERN) + 12] ^= 1
    active.write_bytes(data)
    monkeypatch.setattr(_sealer.Sealer, "submit", lambda *_, **__: pytest.fail("in background"))
    writer = LogWriter(log_path, fsync=BY_HAND)
    assert writer.next_offset == 5
    assert {p.name for p in log_path.glob("*.mcap")} == {
        segment_path(log_path, base, SEALED).name for base in (0, 3)
    }
    with LogReader(log_path) as reader:
        assert [e.payload for e in reader.read()] == [b"%d" % n for n in range(5)]
    writer.close()
    assert {f.kind for f in verify_log(log_path).findings} == {"schema"}


def test_a_writer_starts_despite_damage_in_a_finished_segment(log_path: Path) -> None:
    """Sealing finds it and seals nothing behind it; nothing behind it is lost."""
    killed(log_path, 5, rotate_events=2)
    active = segment_path(log_path, 0, ACTIVE)
    data = bytearray(active.read_bytes())
    data[data.index(_mcap.MARK_PATTERN) - 1] ^= 1
    active.write_bytes(data)
    writer = LogWriter(log_path, fsync=ALWAYS)
    assert writer.append(KEY, b"5") == 5
    with pytest.raises(LogError, match=r"CRC; run `mapfold log recover"):
        writer.close()
    with LogReader(log_path) as reader, pytest.raises(LogDamaged):
        list(reader.read())
    recover_log(log_path)
    kept = [e.payload for e in read_log(log_path) if e.key == KEY]
    assert kept == [b"1", b"2", b"3", b"4", b"5"]


def test_a_writer_refuses_to_start_on_damage_in_the_last_segment(log_path: Path) -> None:
    killed(log_path, 5, rotate_events=100)
    active = segment_path(log_path, 0, ACTIVE)
    data = bytearray(active.read_bytes())
    data[data.index(_mcap.MARK_PATTERN) - 1] ^= 1
    active.write_bytes(data)
    with pytest.raises(LogDamaged, match="offsets 0 to 0 were recorded and cannot be read"):
        LogWriter(log_path)


def test_an_empty_log_keeps_its_id_where_the_next_writer_dies(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before it has made a segment of its own: killed, or stopped by a full disk."""
    with LogWriter(log_path) as writer:
        log_id = writer.log_id

    def create(_: ActiveSegment) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full:
        full.setattr(ActiveSegment, "create", create)
        with pytest.raises(LogError, match="free space"):
            LogWriter(log_path)
    with LogReader(log_path) as reader:
        assert reader.log_id == log_id
    with LogWriter(log_path) as writer:
        assert (writer.log_id, writer.append(KEY, b"0")) == (log_id, 0)
    assert [f.kind for f in verify_log(log_path).findings] == ["schema"]
