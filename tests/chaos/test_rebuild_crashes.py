"""Whatever dies or fails during a rebuild, a whole map is served, and the next rebuild works."""

import json
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import psycopg
import pytest

from projections.fold.map_errors import DatabaseError, DatabaseUnavailable
from projections.fold.settings import Settings
from projections.postgres import RebuildProgress, rebuild
from projections.postgres.connection import Targets, connect, describe_target
from projections.postgres.embedded import EmbeddedServer
from projections.postgres.loader import Load, copy_vectors
from projections.postgres.vector_sink import VectorShadow
from tests.support import prefork
from tests.support.logs import bridge, walk, write_log
from tests.support.rows import all_rows
from tests.support.servers import server_to_kill
from tests.support.thorough import every_other, mostly_slow, rounds

SETTINGS = Settings()
WAIT_S = 240.0
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def own_server() -> Iterator[EmbeddedServer]:
    with server_to_kill() as server:
        yield server


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log whose rebuild takes a hundred statements."""
    return write_log(tmp_path / "log", walk(60) + list(bridge()))


def in_small_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the thread write while the fold goes on, also for a small log."""
    # The package's name for it is the function.
    monkeypatch.setattr(sys.modules["projections.postgres.shadows"], "STREAM_ROWS", 20)
    monkeypatch.setattr(sys.modules["projections.postgres.rebuild"], "TICK_EVENTS", 8)


def at_stage(stage: str, act: Callable[[], None]) -> Callable[[RebuildProgress], None]:
    """Call ``act`` once when a rebuild is at ``stage``."""
    done: list[str] = []

    def on_progress(at: RebuildProgress) -> None:
        if at.stage == stage and at.done > 0 and not done:
            done.append(stage)
            act()

    return on_progress


@pytest.mark.parametrize("kind", ["two_databases", "one_database"][: rounds(2, 1)])
@pytest.mark.slow
def test_killed_at_any_statement(log: Path, kind: str, request: pytest.FixtureRequest) -> None:
    targets: Targets = request.getfixturevalue(kind)
    result = prefork.run(
        "scripts.programs.chaos.rebuild_killer:main",
        ["rebuild_killer", str(log), targets.graph_url, targets.vector_url],
        env=os.environ, cwd=ROOT, timeout=WAIT_S,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["wrong"] == []
    assert found["old"] > rounds(3, 2)
    assert found["new"] >= 1


@pytest.mark.parametrize("stage", mostly_slow(["writing", "folding", "swapping"]))
@pytest.mark.slow
def test_a_terminated_session_ends_the_rebuild_with_a_message(
    log: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    in_small_streams(monkeypatch)
    rebuild(log, one_database, SETTINGS, until=30)
    old = all_rows(one_database)

    def end_sessions() -> None:
        with connect(one_database.graph_url, autocommit=True) as admin:
            admin.execute(
                "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity"
                " WHERE datname = current_database() AND application_name = 'mapfold replay'"
            )

    with pytest.raises(DatabaseUnavailable):
        rebuild(log, one_database, SETTINGS, progress=at_stage(stage, end_sessions))
    assert all_rows(one_database) == old
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) != old


@pytest.mark.parametrize(
    ("of", "stage"),
    every_other(product(["graph_url", "vector_url"], ["folding", "writing", "swapping"])),
)
def test_the_message_names_which_of_two_databases_failed(
    log: Path, two_databases: Targets, monkeypatch: pytest.MonkeyPatch, of: str, stage: str
) -> None:
    in_small_streams(monkeypatch)
    url: str = getattr(two_databases, of)

    def end_sessions() -> None:
        with connect(url, autocommit=True) as admin:
            admin.execute(
                "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity"
                " WHERE datname = current_database() AND application_name = 'mapfold replay'"
            )

    with pytest.raises(DatabaseUnavailable, match=f"^{re.escape(describe_target(url))}: "):
        rebuild(log, two_databases, SETTINGS, progress=at_stage(stage, end_sessions))


@pytest.mark.slow
def test_rows_that_the_server_refuses_while_the_fold_goes_on(
    log: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_small_streams(monkeypatch)
    rebuild(log, one_database, SETTINGS, until=30)
    old = all_rows(one_database)
    calls: list[int] = []

    def twice_the_second_time(schema: str, rows: Sequence[Any]) -> Load:
        calls.append(len(rows))
        return copy_vectors(schema, [*rows, *rows] if len(calls) == 2 else rows)

    with monkeypatch.context() as patched:
        patched.setattr("projections.postgres.vector_sink.copy_vectors", twice_the_second_time)
        with pytest.raises(DatabaseError, match="duplicate key"):
            rebuild(log, one_database, SETTINGS)
    assert len(calls) >= 2  # made ready ahead of what was refused
    assert all_rows(one_database) == old
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) != old


def kill(server: EmbeddedServer) -> None:
    with psycopg.connect(server.url, autocommit=True) as witness:
        os.kill(int((server.data / "postmaster.pid").read_text().split()[0]), signal.SIGKILL)
        with pytest.raises(psycopg.OperationalError):
            list(witness.notifies(timeout=WAIT_S))


def test_postgres_is_killed_during_a_rebuild(
    log: Path, own_server: EmbeddedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_small_streams(monkeypatch)
    targets = Targets(own_server.url, own_server.url, own_server)
    rebuild(log, targets, SETTINGS, until=30)
    with connect(own_server.url, autocommit=True) as admin:
        admin.execute("CHECKPOINT")  # what is asked here is not what a crash may take back
    old = all_rows(targets)

    with pytest.raises(DatabaseUnavailable):
        rebuild(log, targets, SETTINGS, progress=at_stage("folding", partial(kill, own_server)))
    own_server.start()
    assert all_rows(targets) == old
    rebuild(log, targets, SETTINGS)
    assert all_rows(targets) != old


def test_an_interrupt_is_raised_also_when_the_server_is_gone(
    tmp_path: Path, own_server: EmbeddedServer
) -> None:
    """Cancelling fails then, which is not reported."""
    targets = Targets(own_server.url, own_server.url, own_server)
    log = write_log(tmp_path / "short", walk(20))
    begun = threading.Event()

    def interrupt(_: RebuildProgress) -> None:
        assert begun.wait(WAIT_S)
        kill(own_server)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patched:
        last = VectorShadow.create

        def and_say_so(self: VectorShadow, connection: psycopg.Connection) -> None:
            last(self, connection)
            begun.set()

        patched.setattr(VectorShadow, "create", and_say_so)
        with pytest.raises(KeyboardInterrupt):
            rebuild(log, targets, SETTINGS, progress=interrupt)
