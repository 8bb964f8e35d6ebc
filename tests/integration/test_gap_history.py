"""The gap ledger of a log, folded from all its events or continued from a saved ledger."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.gaps import Gap, GapLedger
from eventsrc.envelope.system_events import LOSS_KEY, Loss
from eventsrc.log import NEVER, Event, LogReader, LogWriter, recover, recover_log
from eventsrc.log import seal as _parts
from eventsrc.log.format import LEDGER
from eventsrc.record import gap_history as ledger_module
from eventsrc.record.append import append_payload
from eventsrc.record.gap_history import (
    fold_and_save_ledger,
    fold_ledger,
    ledger_of,
    save_ledger,
    unread_events,
)
from eventsrc.record.log_info import log_info
from tests.support.envelopes import detection, envelope, payload
from tests.support.fixtures_log import BY_HAND, flip

KEY = "tb/detections"
SAVED_AT = 7


def _loss(**fields: object) -> bytes:
    return Loss.model_validate(fields).model_dump_json().encode()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """run-a lacks 2–4 (reported), 6 and 8; run-b lacks nothing; a bare list counts nothing."""
    path = tmp_path / "log"
    with LogWriter(path) as writer:
        append_payload(writer, KEY, payload(envelope(1)))
        append_payload(writer, KEY, payload([detection()]))
        append_payload(writer, KEY, payload(envelope(5)))
        gap = {"publisher": "run-a", "first": 2, "last": 4, "count": 3, "cause": "keyframe_gap"}
        writer.append(LOSS_KEY, _loss(**gap))
        append_payload(writer, KEY, payload(envelope(7, run_id="run-b")))
        append_payload(writer, KEY, b"rejected")
        append_payload(writer, KEY, payload([detection()]))
        assert writer.next_offset == SAVED_AT
        append_payload(writer, KEY, payload(envelope(7)))
        append_payload(writer, "robots/2", payload(envelope(9)))
        writer.append(LOSS_KEY, _loss(publisher=KEY, count=5, cause="queue_full"))
        writer.append(LOSS_KEY, _loss(publisher=KEY, count=2, cause="queue_full"))
        writer.append(LOSS_KEY, _loss(publisher="zid:1", count=1, cause="transport_miss"))
    return path


def _ledger(log: Path) -> GapLedger:
    with LogReader(log) as reader:
        return ledger_of(reader, now_ns=0)


def test_unread_events_are_those_behind_the_saved_ledger(log: Path) -> None:
    with LogReader(log) as reader:
        assert unread_events(reader) == 12
        _save(log)
        assert unread_events(reader) == 5


def test_the_ledger_is_folded_from_the_events(log: Path) -> None:
    ledger = _ledger(log)
    assert list(ledger.gaps()) == [Gap("run-a", 2, 4), Gap("run-a", 6, 6), Gap("run-a", 8, 8)]
    assert ledger.flush() == [Gap("run-a", 6, 6), Gap("run-a", 8, 8)], "2–4 is reported already"


def test_log_info_counts_reported_losses_less_late_keyframes(log: Path) -> None:
    assert log_info(log).lost == 3 + 7 + 1
    with LogWriter(log) as writer:
        for k in (3, 2, 6, 3):
            append_payload(writer, KEY, payload(envelope(k)))
        endless = {"publisher": "run-c", "first": 1, "last": 2**62, "count": 2**62}
        writer.append(LOSS_KEY, _loss(**endless, cause="keyframe_gap"))
    assert log_info(log).lost == 1 + 7 + 1 + 2**62


def _save(log: Path, *, log_id: str | None = None, next_offset: int = SAVED_AT) -> None:
    """Save a ledger that holds one run more than the log, so that one sees whether it is used."""
    with LogReader(log) as reader:
        ledger = GapLedger()
        ledger.record("from-the-cache", 1, 0)
        save_ledger(log, log_id or reader.log_id, next_offset, ledger)


def _holds(ledger: GapLedger, run_id: str, keyframe_id: int) -> bool:
    return any(
        run.first <= keyframe_id <= run.last
        and not any(first <= keyframe_id <= last for first, last, _ in run.holes)
        for run in ledger.state()
        if run.run_id == run_id
    )


def test_folding_continues_from_a_saved_ledger(log: Path) -> None:
    _save(log)
    ledger = _ledger(log)
    assert _holds(ledger, "from-the-cache", 1)
    assert _holds(ledger, "run-a", 7)
    assert not _holds(ledger, "run-b", 7), "the log before the saved offset is not read"


@pytest.mark.parametrize("spoil", ["other log", "longer than the log", "torn"])
def test_an_unusable_saved_ledger_is_ignored(log: Path, spoil: str) -> None:
    if spoil == "other log":
        _save(log, log_id="0" * 32)
    elif spoil == "longer than the log":
        _save(log, next_offset=1_000)
    else:
        _save(log)
    if spoil == "torn":
        (log / LEDGER).write_text((log / LEDGER).read_text()[:-9])
    assert not _holds(_ledger(log), "from-the-cache", 1)
    assert _ledger(log).missing == 5


LONG = 12


@pytest.fixture
def long_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keyframes 0 to 11 of run-a, an event a chunk, in segments of four events."""
    monkeypatch.setattr(_parts, "CHUNK_BYTES", 1)
    path = tmp_path / "log"
    with LogWriter(path, fsync=BY_HAND, rotate_events=4) as writer:
        for k in range(LONG):
            append_payload(writer, KEY, payload(envelope(k)))
            if k % 4 == 3:
                writer.sync()
                writer.commit_if_due()
    return path


def _segment(log: Path, base: int) -> Path:
    return log / f"{base:020d}.mcap"


def _rot_the_event(log: Path, offset: int) -> None:
    with LogReader(log) as reader:
        (entry,) = (s for s in reader.segments if s.base <= offset < s.base + 4)
        chunk = reader.open_segment(entry).chunks[offset - entry.base]
        assert chunk.first == offset
    flip(entry.path, chunk.position + chunk.length // 2)


def _saved(log: Path) -> GapLedger:
    """The ledger of the whole log, saved as a recorder saves it."""
    ledger = _ledger(log)
    with LogReader(log) as reader:
        save_ledger(log, reader.log_id, reader.next_offset, ledger)
        assert unread_events(reader) == 0
    return ledger


@pytest.mark.parametrize("copies", ["kept", "deleted"])
def test_recovery_leaves_no_ledger_of_lost_events(long_log: Path, copies: str) -> None:
    for lost, offset in enumerate((1, 2, 9), start=1):
        _saved(long_log)
        _rot_the_event(long_log, offset)
        recover_log(long_log)
        if copies == "deleted":
            for copy in long_log.glob("*.damaged*"):
                copy.unlink()
        assert _ledger(long_log).missing == lost
    assert _saved(long_log).missing == 3


@pytest.mark.parametrize(("base", "missing"), [(0, 0), (4, 4)])
def test_a_missing_segment_invalidates_the_saved_ledger(
    long_log: Path, base: int, missing: int
) -> None:
    _saved(long_log)
    _segment(long_log, base).unlink()
    with LogReader(long_log) as reader:
        assert unread_events(reader) == LONG
    with pytest.raises(LogDamaged, match=f"offsets {base} to {base + 3}"):
        _ledger(long_log)
    recover_log(long_log)
    ledger = _ledger(long_log)
    assert ledger.missing == missing
    assert not _holds(ledger, "run-a", base)


def test_recovery_deletes_the_saved_ledger_first(
    long_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _saved(long_log)
    _rot_the_event(long_log, 5)
    before = _segment(long_log, 4).read_bytes()

    def crash(*_: object) -> None:
        raise RuntimeError("as if killed")

    monkeypatch.setattr(recover, "rebuild_segment", crash)
    with pytest.raises(RuntimeError):
        recover_log(long_log)
    assert _segment(long_log, 4).read_bytes() == before
    assert not (long_log / LEDGER).exists()


@pytest.mark.parametrize("base", [0, 4, 8])
def test_a_replaced_segment_invalidates_the_saved_ledger(long_log: Path, base: int) -> None:
    """As when a folder is put together again from copies."""
    _saved(long_log)
    saved = (long_log / LEDGER).read_bytes()
    _rot_the_event(long_log, base + 1)
    recover_log(long_log)
    (long_log / LEDGER).write_bytes(saved)
    assert not _holds(_ledger(long_log), "run-a", base + 1)


def test_a_power_cut_of_unsynced_events_invalidates_their_ledger(tmp_path: Path) -> None:
    """Under --fsync never a log may come back shorter, and grow again by other events."""
    log, copy = tmp_path / "log", tmp_path / "copy"
    with LogWriter(log, fsync=NEVER) as writer:
        for k in range(3):
            append_payload(writer, KEY, payload(envelope(k)))
            writer.sync()
        shutil.copytree(log, copy)  # what will be on the disk
        append_payload(writer, KEY, payload(envelope(3)))
        writer.sync()
        _saved(log)
        shutil.copy(log / LEDGER, copy)
    with LogWriter(copy) as writer:
        append_payload(writer, KEY, payload(envelope(7)))
        writer.sync()
        with LogReader(copy) as reader:
            assert unread_events(reader) == 4
        assert list(_ledger(copy).gaps()) == [Gap("run-a", 3, 6)]


def test_sealing_keeps_the_saved_ledger_valid(tmp_path: Path) -> None:
    log = tmp_path / "log"
    with LogWriter(log, fsync=BY_HAND) as writer:
        append_payload(writer, KEY, payload(envelope(1)))
        writer.sync()
        _saved(log)
    with LogWriter(log) as writer:
        append_payload(writer, KEY, payload(envelope(2)))
    assert len(list(log.glob("*.mcap"))) == 2
    with LogReader(log) as reader:
        assert unread_events(reader) == 1


def test_continuing_from_a_save_equals_reading_everything(log: Path) -> None:
    whole = _ledger(log)
    with LogReader(log) as reader:
        half = GapLedger()
        fold_ledger(reader.read(0, SAVED_AT), half, 0)
        save_ledger(log, reader.log_id, SAVED_AT, half)
    again = _ledger(log)
    assert again.state() == whole.state()
    assert again.flush() == whole.flush()


class Counted:
    """Counts the events that are read of a log; reading stops, as if killed, at ``kill_at``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.read = 0
        self.kill_at: int | None = None
        real = LogReader.read

        def read(reader: LogReader, *args: Any, **options: Any) -> Iterator[Event]:
            for event in real(reader, *args, **options):
                if event.offset == self.kill_at:
                    raise KeyboardInterrupt
                self.read += 1
                yield event

        monkeypatch.setattr(LogReader, "read", read)

    def keep(self, log: Path) -> tuple[int, GapLedger | None]:
        """How many events are read for the ledger, and the ledger unless killed before."""
        self.read = 0
        with LogReader(log) as reader:
            try:
                ledger = fold_and_save_ledger(reader)
            except KeyboardInterrupt:
                return self.read, None
        return self.read, ledger


def test_a_killed_first_reading_is_continued(
    long_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = _ledger(long_log).state()
    monkeypatch.setattr(ledger_module, "SAVE_EVERY", 5)
    counted = Counted(monkeypatch)
    counted.kill_at = 7
    assert counted.keep(long_log) == (7, None)
    assert counted.keep(long_log) == (2, None), "from offset 5 on"
    counted.kill_at = None
    read, found = counted.keep(long_log)
    assert read == LONG - 5
    assert found is not None
    assert found.state() == whole
    assert counted.keep(long_log)[0] == 0


def test_an_unwritable_cache_is_no_error(tmp_path: Path) -> None:
    (tmp_path / f"{LEDGER}.new").mkdir()
    save_ledger(tmp_path, "id", 0, GapLedger())
    assert not (tmp_path / LEDGER).exists()
