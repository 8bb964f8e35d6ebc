"""Commands and events that a refold cannot obey or fold, and refolds that end early."""

import threading
from pathlib import Path

import psycopg
import pytest

from eventsrc.envelope import commands
from eventsrc.envelope.commands import Command
from eventsrc.envelope.model import Offset
from projections.fold.map_errors import DatabaseError, FoldError, ImpossibleCommand
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets, statements
from projections.postgres.status import projection_status
from tests.support.logs import (
    append_command,
    append_raw,
    command,
    forget_run,
    undo,
    walk,
    write_log,
)
from tests.support.rows import (
    LOG_LENGTH,
    SETTINGS,
    WAIT_S,
    all_rows,
    fresh_rows,
    tailing,
    three_rooms,
)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return three_rooms(tmp_path)


@pytest.mark.slow
def test_a_refold_parks_what_it_cannot_fold(
    log: Path, targets: Targets, third_database: Targets
) -> None:
    append_raw(log, b"not an envelope")
    tail(log, targets, SETTINGS, once=True)
    append_command(log, forget_run("run-b"))
    append_raw(log, b"nor is this")
    report = tail(log, targets, SETTINGS, once=True)
    assert [letter.offset for letter in report.parked] == [122]  # 120 was parked before
    for sink in projection_status(log, targets, SETTINGS).sinks:
        assert [letter.offset for letter in sink.dead_letters] == [120, 122]
    tail(log, third_database, SETTINGS, once=True)
    assert all_rows(targets) == all_rows(third_database)
    assert [c.sound for c in check(log, targets, SETTINGS)] == [True, True]


def test_a_command_that_cannot_be_read_stops_the_tail_and_changes_nothing(
    log: Path, one_database: Targets
) -> None:
    tail(log, one_database, SETTINGS, once=True)
    before = all_rows(one_database)
    append_raw(log, b'{"kind": "tidy-up"}', key="mapfold/command")
    for refused in (tail, rebuild):
        with pytest.raises(FoldError, match="event at offset 120 cannot be folded"):
            refused(log, one_database, SETTINGS)  # type: ignore[operator]
    assert all_rows(one_database) == before


def beyond_the_map(run_id: str) -> Command:
    """As a raw sender can give it; `mapfold edit` refuses it."""
    return command(
        commands.CorrectPoses,
        run_id=run_id,
        transform=commands.RigidTransform(cos=1.0, sin=0.0, dx=1e7, dy=1e7, dyaw=0.0),
    )


def test_a_command_that_no_fold_can_obey_leaves_the_old_map(log: Path, targets: Targets) -> None:
    tail(log, targets, SETTINGS, once=True)
    before = all_rows(targets)
    bad = beyond_the_map("run-c")
    at = append_command(log, bad)
    says = (
        rf"offset \d+ .*{bad.command_id} at offset {at} .*edit LOG undo {bad.command_id} --reason"
    )
    with pytest.raises(ImpossibleCommand, match=says):
        tail(log, targets, SETTINGS, once=True)
    assert all_rows(targets) == before
    status = projection_status(log, targets, SETTINGS)
    assert [s.dead_letters for s in status.sinks] == [(), ()]
    append_command(log, undo(bad))
    assert tail(log, targets, SETTINGS, once=True).parked == []
    assert all_rows(targets) == before


@pytest.mark.slow
def test_a_live_tail_tries_an_impossible_command_again_when_another_comes(
    log: Path, targets: Targets, third_database: Targets
) -> None:
    notes: list[str] = []
    noted = threading.Semaphore(0)

    def note(text: str) -> None:
        notes.append(text)
        noted.release()

    with tailing(log, targets, note=note) as (progress, running):
        assert progress.wait(Offset(LOG_LENGTH), WAIT_S)
        before = all_rows(targets)
        bad = beyond_the_map("run-c")
        append_command(log, bad)
        assert noted.acquire(timeout=WAIT_S)
        write_log(log, walk(4, seed=6, run_id="run-e"))
        assert all_rows(targets) == before
        append_command(log, forget_run("run-b"))
        assert noted.acquire(timeout=WAIT_S)
        assert all_rows(targets) == before
        at = append_command(log, undo(bad))
        assert progress.wait(Offset(at + 1), WAIT_S)
    assert len(notes) == 2
    assert bad.command_id in notes[0]
    assert (running.result().refolds, running.result().parked) == (1, [])
    assert all_rows(targets) == fresh_rows(log, third_database)


def test_a_stopped_refold_leaves_the_old_map(
    log: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch, third_database: Targets
) -> None:
    monkeypatch.setattr("projections.postgres.refold.TICK_EVENTS", 10)
    tail(log, one_database, SETTINGS, once=True)
    before = all_rows(one_database)
    append_command(log, forget_run("run-b"))
    stop = threading.Event()
    report = tail(log, one_database, SETTINGS, stop=stop, on_refold=lambda *_: stop.set())
    assert report.refolds == 0
    assert all_rows(one_database) == before
    tail(log, one_database, SETTINGS, once=True)
    assert all_rows(one_database) == fresh_rows(log, third_database)


def test_a_role_that_may_not_make_tables_is_told_who_can(
    log: Path, one_database: Targets, pg: psycopg.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    tail(log, one_database, SETTINGS, once=True)
    append_command(log, forget_run("run-b"))
    monkeypatch.setitem(statements("checkpoint"), "may_create", psycopg.sql.SQL("SELECT false"))
    with pytest.raises(DatabaseError, match=r"have their owner make it.*mapfold replay"):
        tail(log, one_database, SETTINGS, once=True)
