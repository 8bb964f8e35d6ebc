"""Whatever dies during a tail, the final rows equal those of a rebuild."""

import json
import os
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import psycopg
import pytest

from projections.fold.map_errors import CheckpointMoved, DatabaseUnavailable
from projections.fold.settings import Settings
from projections.postgres import TailProgress, TailReport, checkpoints, rebuild, tail
from projections.postgres.connection import Connection, Targets, connect
from projections.postgres.embedded import EmbeddedServer
from projections.postgres.labels import SinkName
from projections.postgres.sink import Checkpoint
from tests.support import prefork
from tests.support.logs import bridge, walk, write_log
from tests.support.rows import all_rows
from tests.support.servers import kill_postgres, server_to_kill
from tests.support.thorough import mostly_slow, rounds

SETTINGS = Settings()
WAIT_S = 120.0
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("kind", ["two_databases", "one_database"][: rounds(2, 1)])
def test_killed_between_any_two_statements(
    tmp_path: Path, kind: str, request: pytest.FixtureRequest
) -> None:
    targets: Targets = request.getfixturevalue(kind)
    log = write_log(tmp_path / "log", walk(12) + list(bridge())[:12])
    result = prefork.run(
        "scripts.programs.chaos.crash_driver:main",
        ["crash_driver", str(log), targets.graph_url, targets.vector_url],
        env=os.environ, cwd=ROOT, timeout=WAIT_S,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["wrong"] == []
    assert found["steps"] > 40


@pytest.fixture
def own_server() -> Iterator[EmbeddedServer]:
    """A server that a test may kill."""
    with server_to_kill() as server:
        yield server


@pytest.mark.slow
def test_postgres_is_killed_again_and_again(tmp_path: Path, own_server: EmbeddedServer) -> None:
    log = write_log(tmp_path / "log", walk(60) + list(bridge()))
    targets = Targets(own_server.url, own_server.url, own_server)
    kills: list[int] = []
    troubles: list[str] = []

    def kill_sometimes(report: TailReport) -> None:
        if report.next_offset in (20, 50) and report.next_offset not in kills:
            kills.append(report.next_offset)
            kill_postgres(own_server)

    report = tail(
        log,
        targets,
        SETTINGS,
        once=True,
        batch_events=10,
        on_batch=kill_sometimes,
        on_trouble=troubles.append,
    )
    assert kills == [20, 50]
    assert troubles
    assert report.next_offset == 80
    tailed = all_rows(targets)
    rebuild(log, targets, SETTINGS)
    assert all_rows(targets) == tailed


@pytest.mark.slow
def test_a_server_that_does_not_start_at_once_is_tried_again(
    tmp_path: Path, own_server: EmbeddedServer
) -> None:
    log = write_log(tmp_path / "log", walk(40))
    targets = Targets(own_server.url, own_server.url, own_server)
    spoilt = own_server.data / "postgresql.auto.conf"
    troubles: list[str] = []

    def spoil(report: TailReport) -> None:
        if report.next_offset == 20 and not troubles:
            kill_postgres(own_server)
            spoilt.write_text("no_such_setting = 1\n")

    def mend(trouble: str) -> None:
        troubles.append(trouble)
        if "no_such_setting" in trouble:
            spoilt.write_text("")

    report = tail(
        log, targets, SETTINGS, once=True, batch_events=10, on_batch=spoil, on_trouble=mend
    )
    assert report.next_offset == 40
    assert "no_such_setting" in troubles[-1]


def cut_connections(url: str) -> None:
    """End every other session of the database and wait until they are gone."""
    with connect(url, autocommit=True) as admin:
        admin.execute(
            "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity"
            " WHERE datname = current_database() AND pid <> pg_backend_pid()"
        )


def test_a_cut_connection_is_reconnected(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(60))

    def cut(_: TailReport) -> None:
        cut_connections(one_database.graph_url)

    report = tail(
        log,
        one_database,
        SETTINGS,
        once=True,
        batch_events=10,
        on_batch=cut,
    )
    assert (report.next_offset, report.batches, report.restarts) == (60, 6, 0)
    tailed = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == tailed


def test_commits_the_server_lost_are_written_again(tmp_path: Path, one_database: Targets) -> None:
    """With synchronous_commit = off a crash loses the last commits, rows and checkpoint."""
    log = write_log(tmp_path / "log", walk(40) + list(bridge()))

    def go_back(report: TailReport) -> None:
        if report.next_offset == 30 and not report.restarts:
            cut_connections(one_database.graph_url)
            rebuild(log, one_database, SETTINGS, until=13)

    report = tail(log, one_database, SETTINGS, once=True, batch_events=10, on_batch=go_back)
    assert (report.next_offset, report.restarts) == (60, 1)
    tailed = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == tailed


@pytest.mark.slow
def test_commits_lost_while_no_event_comes_are_written_again(
    tmp_path: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The heartbeat finds the connection lost; there is no batch to compare with."""
    monkeypatch.setattr(sys.modules["projections.postgres.batch_writer"], "HEARTBEAT_S", 0.0)
    log = write_log(tmp_path / "log", walk(40))
    progress, stop, lost = TailProgress(), threading.Event(), threading.Event()

    def go_back(_: str) -> None:
        if not lost.is_set():
            rebuild(log, one_database, SETTINGS, until=13)
            lost.set()

    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(
            tail, log, one_database, SETTINGS, stop=stop, progress=progress, on_trouble=go_back
        )
        try:
            assert progress.wait(40, WAIT_S)
            cut_connections(one_database.graph_url)
            assert lost.wait(WAIT_S)
            write_log(log, list(bridge()))
            assert progress.wait(60, WAIT_S)
        finally:
            stop.set()
        assert running.result(WAIT_S).restarts == 1
    tailed = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == tailed


@pytest.mark.parametrize("again", mostly_slow([1, 3]))
def test_a_connection_cut_again_while_the_checkpoint_is_read(
    tmp_path: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch, again: int
) -> None:
    log = write_log(tmp_path / "log", walk(40))
    load, cuts = checkpoints.load, []

    def cut_first(connection: Connection, sink: SinkName) -> Checkpoint | None:
        if cuts and len(cuts) <= again:
            cuts.append(None)
            cut_connections(one_database.graph_url)
        return load(connection, sink)

    def cut(report: TailReport) -> None:
        if not cuts:
            cuts.append(None)
            cut_connections(one_database.graph_url)

    monkeypatch.setattr("projections.postgres.checkpoints.load", cut_first)
    report = tail(log, one_database, SETTINGS, once=True, batch_events=10, on_batch=cut)
    assert (report.next_offset, len(cuts)) == (40, again + 1)


@pytest.mark.slow
def test_a_new_pass_waits_for_a_database_that_is_away(
    tmp_path: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_log(tmp_path / "log", walk(40))
    begin, cuts = checkpoints.create, []

    def go_back(report: TailReport) -> None:
        if report.next_offset == 30 and not report.restarts:
            cut_connections(one_database.graph_url)
            rebuild(log, one_database, SETTINGS, until=13)
            monkeypatch.setattr("projections.postgres.checkpoints.create", cut_first)

    def cut_first(*args: Any) -> None:
        if len(cuts) < 2:
            cuts.append(None)
            cut_connections(one_database.graph_url)
        begin(*args)

    report = tail(log, one_database, SETTINGS, once=True, batch_events=10, on_batch=go_back)
    assert (report.next_offset, report.restarts, len(cuts)) == (40, 1, 2)


def test_a_checkpoint_moved_by_another_writer_stops_the_tail(
    tmp_path: Path, one_database: Targets
) -> None:
    log = write_log(tmp_path / "log", walk(40))

    def overtake(_: TailReport) -> None:
        cut_connections(one_database.graph_url)
        rebuild(log, one_database, SETTINGS, until=33)

    with pytest.raises(CheckpointMoved, match="something else writes there"):
        tail(log, one_database, SETTINGS, once=True, batch_events=10, on_batch=overtake)


def test_a_checkpoint_moved_during_a_transaction_changes_no_row(
    tmp_path: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    log = write_log(tmp_path / "log", walk(40))
    seen = []

    def move(_: TailReport) -> None:
        pg.execute(
            "UPDATE mapfold.checkpoint SET next_offset = next_offset + 1 WHERE sink = 'graph'"
        )
        seen.append(all_rows(one_database))

    with pytest.raises(CheckpointMoved, match="expected at offset 10 of log"):
        tail(log, one_database, SETTINGS, once=True, batch_events=10, on_batch=move)
    assert all_rows(one_database) == seen[-1]


def test_a_stopped_tail_gives_up_on_a_database_that_is_away(
    tmp_path: Path, own_server: EmbeddedServer
) -> None:
    log = write_log(tmp_path / "log", walk(20))
    targets = Targets(own_server.url, own_server.url)  # it is not restarted
    stop = threading.Event()

    def kill_then_stop(_: TailReport) -> None:
        kill_postgres(own_server)
        write_log(log, walk(5, first=20))

    with pytest.raises(DatabaseUnavailable, match="stopped while the database was away"):
        tail(
            log,
            targets,
            SETTINGS,
            stop=stop,
            on_batch=kill_then_stop,
            on_trouble=lambda _: stop.set(),
        )
