"""`replay --workers`: the databases, the reports and the errors are those of one process."""

import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged, MapfoldError
from eventsrc.log import LogReader
from projections.fold.map_errors import FoldError
from projections.fold.settings import Settings
from projections.map import parsed_log
from projections.map.parsed_log import ParsedLog
from projections.postgres import RebuildReport, rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.rebuild import RebuildProgress
from tests.integration.test_parsed_log import pids
from tests.support.fixtures_log import flip
from tests.support.logs import append_raw, walk, write_log, write_random_log
from tests.support.rows import all_rows
from tests.support.thorough import THOROUGH, rounds

SETTINGS = Settings(embedding_dim=8)
EVIDENCE = Settings(embedding_dim=8, fusion="evidence", places="rooms")


@pytest.fixture(autouse=True)
def _small_ranges(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that small logs are shared out, by processes that have started."""
    monkeypatch.setattr(parsed_log, "MIN_EVENTS", 1)
    monkeypatch.setattr(parsed_log, "EVENTS_PER_WORKER", 1)
    monkeypatch.setattr(parsed_log, "_RANGE_BYTES", 8192)
    enter = ParsedLog.__enter__

    def ready(self: ParsedLog) -> ParsedLog:
        enter(self)
        for process in self._alive:
            process.connection.poll(60)
        return self

    monkeypatch.setattr(ParsedLog, "__enter__", ready)


def untimed(report: RebuildReport) -> RebuildReport:
    return replace(report, fold_s=0.0, total_s=0.0, workers=0, lost_workers=0)


def said(log: Path, targets: Targets, workers: int) -> str:
    """The error of a replay, which must leave the databases as they are."""
    before = all_rows(targets)
    with pytest.raises(MapfoldError) as caught:
        rebuild(log, targets, SETTINGS, workers=workers)
    assert all_rows(targets) == before
    return f"{type(caught.value).__name__}: {caught.value}"


@pytest.mark.seconds
@pytest.mark.parametrize("settings", [SETTINGS, pytest.param(EVIDENCE, marks=pytest.mark.slow)])
def test_rows_and_reports_are_those_of_one_process(
    tmp_path: Path, two_databases: Targets, settings: Settings
) -> None:
    log = write_random_log(tmp_path / "log", 7, rounds(400, 150))
    for until in (None, 217)[: rounds(2, 1)]:
        alone = rebuild(log, two_databases, settings, until=until, workers=0)  # type: ignore[arg-type]
        rows = all_rows(two_databases)
        assert rows[1]
        for workers in (1, 2, 3) if THOROUGH else (2,):
            found = rebuild(log, two_databases, settings, until=until, workers=workers)  # type: ignore[arg-type]
            assert (found.workers, found.lost_workers) == (workers, 0)
            assert untimed(found) == untimed(alone)
            assert all_rows(two_databases) == rows
    tail(log, two_databases, settings, once=True)
    tailed = all_rows(two_databases)
    rebuild(log, two_databases, settings, workers=0)
    assert all_rows(two_databases) == tailed


@pytest.mark.slow
@pytest.mark.seconds
def test_errors_are_those_of_one_process(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(150))
    append_raw(log, b'{"run_id": 1}')
    write_log(log, walk(40, first=150))
    rebuild(log, one_database, SETTINGS, until=40, workers=0)  # type: ignore[arg-type]
    unfit = said(log, one_database, 0)
    assert unfit.startswith("FoldError: event at offset 150 cannot be folded: ")
    workers = rounds(2, 1)
    assert said(log, one_database, workers) == unfit
    file = min(log.glob("*.mcap"))
    flip(file, file.stat().st_size // 3)
    damaged = said(log, one_database, 0)
    assert damaged.startswith("LogDamaged: ")
    assert said(log, one_database, workers) == damaged


@pytest.mark.seconds
@pytest.mark.parametrize(
    "stop", [KeyboardInterrupt, pytest.param(MemoryError, marks=pytest.mark.slow)]
)
def test_an_interruption_ends_the_processes_and_keeps_the_map(
    tmp_path: Path,
    one_database: Targets,
    stop: Callable[[], BaseException],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    log = write_log(tmp_path / "log", walk(300))
    rebuild(log, one_database, SETTINGS, until=100, workers=0)  # type: ignore[arg-type]
    before, started = all_rows(one_database), list[int]()
    stretches = ParsedLog.stretches
    monkeypatch.setattr(
        ParsedLog, "stretches", lambda self: started.extend(pids(self)) or stretches(self)
    )

    def interrupted(at: RebuildProgress) -> None:
        if at.stage == "folding":
            raise stop()

    with pytest.raises(stop):  # type: ignore[arg-type]
        rebuild(log, one_database, SETTINGS, workers=2, progress=interrupted)
    assert all_rows(one_database) == before
    assert len(started) == 2
    for pid in started:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.seconds
def test_a_killed_process_is_reported_and_the_map_is_right(
    tmp_path: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_random_log(tmp_path / "log", 7, rounds(400, 150))
    alone = rebuild(log, one_database, SETTINGS, workers=0)
    rows, stretches = all_rows(one_database), ParsedLog.stretches

    def killed(self: ParsedLog) -> object:
        found = stretches(self)
        yield next(found)
        os.kill(pids(self)[0], signal.SIGKILL)
        yield from found

    monkeypatch.setattr(ParsedLog, "stretches", killed)
    found = rebuild(log, one_database, SETTINGS, workers=2)
    assert (found.workers, found.lost_workers) == (2, 1)
    assert untimed(found) == untimed(alone)
    assert all_rows(one_database) == rows


def test_the_first_trouble_is_the_one_that_is_named(tmp_path: Path, one_database: Targets) -> None:
    """An event that cannot be folded comes before damage in the same stretch."""
    log = tmp_path / "log"
    append_raw(log, b'{"run_id": 1}')
    for k in range(3):
        write_log(log, walk(2, first=2 * k))
    with LogReader(log) as reader:
        last = reader.open_segment(reader.segments[-1])
        flip(last.path, last.chunks[0].position + last.chunks[0].length // 2)
    with LogReader(log) as reader, pytest.raises(LogDamaged):
        list(reader.read())
    with pytest.raises(FoldError, match="offset 0 "):
        rebuild(log, one_database, SETTINGS, workers=0)
