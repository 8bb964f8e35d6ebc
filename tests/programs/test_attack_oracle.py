"""The attack's own judgement: it must notice what it is there to notice."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from scripts.programs.attack.attacked_command import _MAPFOLD, AttackedCommand
from scripts.programs.attack.oracle import Judgement, Oracle, digest
from scripts.programs.attack.tally import ANSWER_LIMIT_S, MEMORY_LIMIT_MB, Tally, table
from tests.support.fixtures_log import envelope, write_log

PAYLOADS = [envelope(k) for k in range(4)]


@pytest.fixture
def oracle() -> Oracle:
    """Knows that the first three were sent, and acknowledged."""
    oracle = Oracle()
    for payload in PAYLOADS[:3]:
        oracle.sent(payload)
    oracle.acknowledged(map(digest, PAYLOADS[:3]))
    return oracle


def test_a_log_with_everything_is_as_it_must_be(oracle: Oracle, log_path: Path) -> None:
    write_log(log_path, PAYLOADS[:3])
    assert oracle.judge(log_path) == Judgement(3, 0, 0)


def test_what_was_acknowledged_and_is_not_there_is_lost(oracle: Oracle, log_path: Path) -> None:
    write_log(log_path, PAYLOADS[:1])
    assert oracle.judge(log_path) == Judgement(3, 2, 0)
    oracle.forget_promises()
    assert oracle.judge(log_path) == Judgement(3, 0, 0)


def test_an_event_that_was_not_sent_counts_as_invented(oracle: Oracle, log_path: Path) -> None:
    write_log(log_path, PAYLOADS)
    assert oracle.judge(log_path) == Judgement(3, 0, 1)


def test_an_event_at_another_offset_than_before_is_invented(oracle: Oracle, tmp_path: Path) -> None:
    write_log(tmp_path / "a", PAYLOADS[:3])
    write_log(tmp_path / "b", [PAYLOADS[1], PAYLOADS[0], PAYLOADS[2]])
    assert oracle.judge(tmp_path / "a").invented == 0
    assert oracle.judge(tmp_path / "b").invented == 2


def _harmed() -> Iterator[Tally]:
    for change in ("lost", "invented", "tracebacks"):
        tally = Tally(change)
        setattr(tally, change, 1)
        yield tally
    large, slow, told = Tally("large"), Tally("slow"), Tally("told")
    large.note_memory("reader", MEMORY_LIMIT_MB + 1, "mapfold log info")
    slow.answered(ANSWER_LIMIT_S + 0.1)
    told.complaints.append("something")
    yield from (large, slow, told)


@pytest.mark.parametrize("tally", [*_harmed()], ids=lambda tally: tally.name)
def test_each_kind_of_harm_is_a_violation(tally: Tally) -> None:
    assert not tally.held
    assert table([tally]).endswith("NO")


def test_a_tally_without_harm_holds() -> None:
    tally = Tally("calm", rounds=2, acknowledged=1_000)
    tally.note_memory("recorder", MEMORY_LIMIT_MB - 1, "mapfold record")
    tally.answered(ANSWER_LIMIT_S - 0.1)
    assert tally.held
    assert table([tally]).endswith("yes")


def test_a_traceback_and_the_memory_of_a_command_are_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing = _MAPFOLD.replace("main()", "bytearray(100_000_000); 1 / 0")
    monkeypatch.setattr("scripts.programs.attack.attacked_command._MAPFOLD", failing)
    attacked = AttackedCommand("reader", [], env=os.environ, cwd=tmp_path)
    try:
        assert attacked.wait() == 1
        assert attacked.faults() == ["Traceback (most recent call last):"]
        assert 100 < attacked.peak_mb() < 1_000
    finally:
        attacked.close()


def test_a_command_leaves_its_numbers_behind(tmp_path: Path) -> None:
    attacked = AttackedCommand("reader", ["--help"], env={**os.environ, "PATH": ""}, cwd=tmp_path)
    try:
        assert attacked.wait() == 0, attacked.lines
        assert "record" in attacked.output()
        assert attacked.peak_mb() > 10
        assert attacked.faults() == []
    finally:
        attacked.close()
