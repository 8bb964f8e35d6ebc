"""A saved gap ledger that was changed is not used, and nothing in it can do harm."""

import contextlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.gaps import GapLedger, RunState, is_consistent
from eventsrc.log import LogReader, LogWriter
from eventsrc.log.format import LEDGER
from eventsrc.record import gap_history as _ledger_cache
from eventsrc.record.append import append_payload
from eventsrc.record.gap_history import MAX_BYTES, encode, fold_and_save_ledger, ledger_of
from tests.support.envelopes import envelope, payload

KEYFRAMES = (1, 2, 5, 6, 9)
"""Of run-a; 3, 4, 7 and 8 are missing."""


@pytest.fixture(scope="module")
def log() -> Iterator[Path]:
    """A log with its saved ledger."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log"
        with LogWriter(path) as writer:
            for keyframe_id in KEYFRAMES:
                append_payload(writer, "tb/detections", payload(envelope(keyframe_id)))
        with LogReader(path) as reader:
            fold_and_save_ledger(reader)
        yield path


def state_beside(log: Path, saved: bytes) -> tuple[RunState, ...]:
    """The ledger that is made of the log with ``saved`` beside it; afterwards as before."""
    before = (log / LEDGER).read_bytes()
    (log / LEDGER).write_bytes(saved)
    try:
        with LogReader(log) as reader:
            return ledger_of(reader, now_ns=0).state()
    finally:
        (log / LEDGER).write_bytes(before)


def right(log: Path) -> tuple[RunState, ...]:
    return state_beside(log, b"")


@given(data=st.data())
def test_any_changed_byte_leaves_the_ledger_equal(log: Path, data: st.DataObject) -> None:
    saved = bytearray((log / LEDGER).read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(saved)))
        length = data.draw(st.integers(0, 4))
        saved[at : at + length] = data.draw(st.binary(max_size=4) | st.just(b"7"))
    assert state_beside(log, bytes(saved)) == right(log)


NUMBERS = st.integers(-3, 12) | st.sampled_from([2**63, -(2**63) - 1, 10**400])
JUNK = st.none() | st.booleans() | st.floats() | st.text(max_size=3) | NUMBERS
HOLES = st.lists(st.lists(NUMBERS | JUNK, max_size=4) | JUNK, max_size=4)
RUNS = st.lists(
    st.tuples(st.sampled_from(["run-a", "b"]), NUMBERS, NUMBERS, HOLES).map(list) | JUNK, max_size=3
)


@given(runs=RUNS | JUNK, next_offset=JUNK, fields=st.dictionaries(st.text(max_size=3), JUNK))
def test_forged_content_with_a_right_checksum_does_no_harm(
    log: Path, runs: Any, next_offset: Any, fields: dict[str, Any]
) -> None:
    """Whoever may write there can make a ledger that could be; but never one that could not."""
    good = json.loads((log / LEDGER).read_bytes())["ledger"]
    forged = {**good, "runs": runs, "next_offset": next_offset, **fields}
    found = state_beside(log, encode(json.dumps(forged).encode()))
    assert is_consistent(found, len(KEYFRAMES))
    ledger = GapLedger()
    ledger.restore(found, 0)
    assert [gap.count > 0 for gap in ledger.flush()] == [True] * len(list(ledger.gaps()))


@pytest.mark.parametrize(
    "holes",
    [
        [[4, 3, False]],  # reversed
        [[3, 4, False], [4, 5, False]],  # overlapping
        [[3, 4, False], [5, 6, False]],  # nothing recorded in between
        [[7, 8, False], [3, 4, False]],  # out of order
        [[1, 2, False]],  # at the first keyframe
        [[8, 9, False]],  # at the last
        [[-5, -4, False]],  # outside
        [[3, 4]],
        [[3, 4, 0]],
        [[3, 4.0, False]],
        [["3", 4, False]],
    ],
)
def test_inconsistent_holes_are_counted_again(log: Path, holes: list[Any]) -> None:
    good = json.loads((log / LEDGER).read_bytes())["ledger"]
    ((run_id, first, last, _),) = good["runs"]
    forged = {**good, "runs": [[run_id, first, last, holes]]}
    told: list[str] = []
    (log / LEDGER).replace(log / "kept")
    (log / LEDGER).write_bytes(encode(json.dumps(forged).encode()))
    with LogReader(log) as reader:
        found = ledger_of(reader, now_ns=0, note=told.append).state()
    (log / "kept").replace(log / LEDGER)
    assert found == right(log)
    assert len(told) == 1
    why = "(its content is not valid: |it holds keyframes or gaps that contradict each other;)"
    assert re.search(rf"{log / LEDGER} is not used: {why}", told[0])
    assert told[0].endswith("counted again from the log")


def _as_folder(path: Path) -> None:
    path.mkdir()


def _as_link(path: Path) -> None:
    path.symlink_to(path.with_name("saved"))


def _as_pipe(path: Path) -> None:
    os.mkfifo(path)


def _as_huge(path: Path) -> None:
    path.touch()
    os.truncate(path, 20 * 2**30)


def _as_deep(path: Path) -> None:
    path.write_bytes(encode(b'{"runs":' + b"[" * 100_000 + b"]" * 100_000 + b"}"))


def _as_no_text(path: Path) -> None:
    path.write_bytes(encode(b'{"format":3,"log_id":"\xff\xfe"}'))


def _as_one_changed_digit(path: Path) -> None:
    path.write_bytes(path.with_name("saved").read_bytes().replace(b"[3,4,", b"[3,8,"))


def _as_older(path: Path) -> None:
    path.write_bytes(b'{"format":2,"log_id":"0","next_offset":0,"segments":[],"runs":[]}')


def _as_many_wrong_values(path: Path) -> None:
    wrong = b"[[]," * (MAX_BYTES // 8) + b"]"
    path.write_bytes(encode(b'{"runs":[["a",0,1,' + wrong + b"]]}"))


@pytest.mark.parametrize(
    "make",
    [
        _as_folder,
        _as_link,
        _as_pipe,
        _as_huge,
        _as_deep,
        _as_no_text,
        _as_one_changed_digit,
        _as_older,
        _as_many_wrong_values,
    ],
)
def test_any_unusable_file_is_reported_and_the_log_counted_again(
    log: Path, tmp_path: Path, make: Any
) -> None:
    copy = tmp_path / "log"
    shutil.copytree(log, copy)
    (copy / LEDGER).rename(copy / "saved")
    make(copy / LEDGER)
    told: list[str] = []
    with LogReader(copy) as reader:
        ledger = fold_and_save_ledger(reader, note=told.append)
        assert ledger.state() == right(log)
        assert ledger.missing == 4
        assert len(told) == 1
        again = fold_and_save_ledger(reader, note=told.append)
        assert again.state() == right(log)
    assert (copy / "saved").read_bytes() == (log / LEDGER).read_bytes()


def test_saving_follows_no_link(log: Path, tmp_path: Path) -> None:
    copy, other = tmp_path / "log", tmp_path / "other"
    shutil.copytree(log, copy)
    other.write_bytes(b"precious")
    (copy / LEDGER).unlink()
    (copy / f"{LEDGER}.new").symlink_to(other)
    with LogReader(copy) as reader:
        fold_and_save_ledger(reader)
    assert other.read_bytes() == b"precious"
    assert (copy / LEDGER).read_bytes() == (log / LEDGER).read_bytes()


@given(
    seen=st.lists(st.tuples(st.sampled_from(["a", "b"]), st.integers(-20, 20)), max_size=30),
)
def test_every_ledger_folded_from_events_is_consistent(seen: list[tuple[str, int]]) -> None:
    ledger = GapLedger()
    for run_id, keyframe_id in seen:
        ledger.record(run_id, keyframe_id, 0)
    assert is_consistent(ledger.state(), len(seen))


def test_a_ledger_over_the_size_limit_is_not_saved(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "log"
    shutil.copytree(log, copy)
    monkeypatch.setattr(_ledger_cache, "MAX_BYTES", 10)
    with contextlib.closing(LogReader(copy)) as reader:
        assert fold_and_save_ledger(reader).state() == right(log)
    assert not (copy / LEDGER).exists()
