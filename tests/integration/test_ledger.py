"""The ledger of a log: what a log lacks, from its events or from a saved ledger and the rest."""

from pathlib import Path

import pytest

from eventsrc._ledger_cache import NAME
from eventsrc.append import append_payload
from eventsrc.ledger import fold_ledger, ledger_of, save_ledger, unread_events
from eventsrc.log import LogReader, LogWriter, log_info
from eventsrc.losses import Gap, GapLedger
from eventsrc.system_events import LOSS_KEY, Loss
from tests.envelopes import detection, envelope, payload

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


def test_how_much_there_is_to_read(log: Path) -> None:
    with LogReader(log) as reader:
        assert unread_events(reader) == 12
        _save(log)
        assert unread_events(reader) == 5


def test_what_a_log_lacks_is_read_from_its_events(log: Path) -> None:
    ledger = _ledger(log)
    assert list(ledger.gaps()) == [Gap("run-a", 2, 4), Gap("run-a", 6, 6), Gap("run-a", 8, 8)]
    assert ledger.flush() == [Gap("run-a", 6, 6), Gap("run-a", 8, 8)], "2–4 is reported already"


def test_log_info_counts_what_was_reported_less_what_came_late(log: Path) -> None:
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


def test_a_saved_ledger_is_gone_on_from(log: Path) -> None:
    _save(log)
    ledger = _ledger(log)
    assert ledger.stretch("from-the-cache", 1) == (1, 1)
    assert ledger.stretch("run-a", 7) == (7, 7)
    assert ledger.stretch("run-b", 7) is None, "the log before the saved offset is not read"


@pytest.mark.parametrize("spoil", ["other log", "longer than the log", "recovered", "torn"])
def test_a_saved_ledger_that_cannot_be_believed_is_not(log: Path, spoil: str) -> None:
    if spoil == "other log":
        _save(log, log_id="0" * 32)
    elif spoil == "longer than the log":
        _save(log, next_offset=1_000)
    else:
        _save(log)
    if spoil == "recovered":
        (log / "00000000000000000000.mcap.damaged").touch()
    elif spoil == "torn":
        (log / NAME).write_text((log / NAME).read_text()[:-9])
    assert _ledger(log).stretch("from-the-cache", 1) is None
    assert _ledger(log).missing == 5


def test_saving_and_going_on_equals_reading_everything(log: Path) -> None:
    whole = _ledger(log)
    with LogReader(log) as reader:
        half = GapLedger()
        fold_ledger(reader.read(0, SAVED_AT), half, 0)
        save_ledger(log, reader.log_id, SAVED_AT, half)
    again = _ledger(log)
    assert again.state() == whole.state()
    assert again.flush() == whole.flush()


def test_that_the_cache_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    (tmp_path / f"{NAME}.new").mkdir()
    save_ledger(tmp_path, "id", 0, GapLedger())
    assert not (tmp_path / NAME).exists()
