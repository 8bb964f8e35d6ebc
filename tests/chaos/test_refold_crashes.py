"""Whatever dies while commands are in the log, the final rows equal those of a fresh replay."""

import json
import os
from pathlib import Path
from typing import Any

import psycopg
import pytest

from projections.fold.map_errors import DatabaseUnavailable
from projections.fold.settings import Settings
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.embedded import EmbeddedServer
from tests.support import prefork
from tests.support.logs import (
    append_command,
    bridge,
    forget_keyframes,
    forget_run,
    keep_apart,
    name_place,
    undo,
    walk,
    write_log,
)
from tests.support.rows import all_rows
from tests.support.servers import kill_postgres, server_to_kill
from tests.support.thorough import rounds, stride

SETTINGS = Settings()
WAIT_S = 280.0
ROOT = Path(__file__).resolve().parents[2]
OLD_END = 30


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A map of three rooms, then a run that joins them."""
    return write_log(tmp_path / "log", walk(20) + list(bridge())[:10])


def kills(log: Path, targets: Targets, every: int, mode: str) -> dict[str, Any]:
    urls = (targets.graph_url, targets.vector_url)
    result = prefork.run(
        "scripts.programs.chaos.refold_killer:main",
        ["refold_killer", str(log), *urls, str(OLD_END), str(every), mode],
        env=os.environ, cwd=ROOT, timeout=WAIT_S,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    found: dict[str, Any] = json.loads(result.stdout)
    return found


@pytest.mark.parametrize("kind", ["two_databases", "one_database"][: rounds(2, 1)])
def test_a_tail_killed_at_any_statement_of_a_refold(
    log: Path, kind: str, request: pytest.FixtureRequest
) -> None:
    forgotten = forget_run("run-b")
    append_command(log, forgotten)
    append_command(log, name_place(3, "kitchen"))
    write_log(log, walk(4, first=20))
    append_command(log, undo(forgotten))
    append_command(log, forget_keyframes(2, 9))
    found = kills(log, request.getfixturevalue(kind), 11 * stride(25), "swaps")
    assert found["wrong"] == []
    assert found["steps"] > 100
    assert found["old"] >= 1
    assert found["new"] >= 1


@pytest.mark.slow
def test_a_tail_killed_at_any_statement_of_a_refold_that_keeps_the_vectors(
    log: Path, one_database: Targets
) -> None:
    append_command(log, keep_apart(0, 1))
    write_log(log, walk(4, first=20))
    found = kills(log, one_database, 11 * stride(25), "swaps")
    assert found["wrong"] == []
    assert found["steps"] > 80


@pytest.mark.slow
def test_a_tail_killed_between_any_two_statements_while_places_are_named(
    log: Path, two_databases: Targets
) -> None:
    for n, name in enumerate(["kitchen", "hall", "kitchen again"]):
        append_command(log, name_place(3, name))
        write_log(log, walk(3, seed=n, first=20 + 3 * n))
    found = kills(log, two_databases, 3 * stride(25), "batches")
    assert found["wrong"] == []
    assert found["steps"] > 20


@pytest.mark.slow
def test_the_server_killed_at_any_statement_of_a_refold(
    log: Path, tmp_path: Path, one_database: Targets
) -> None:
    """The tail lives on, connects again and refolds from the start."""
    append_command(log, forget_run("run-b"))
    append_command(log, name_place(3, "kitchen"))
    write_log(log, walk(4, first=20))
    rebuild(log, one_database, SETTINGS)
    expected = all_rows(one_database)
    execute, killed, steps = psycopg.Cursor.execute, 0, range(5, 10_000, 45 * stride(5))
    with server_to_kill() as server:
        targets = Targets(server.url, server.url, server)
        for step in steps:
            rebuild(log, targets, SETTINGS, until=OLD_END)  # type: ignore[arg-type]
            bomb, troubles = ServerBomb(server, step, execute), list[str]()
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(psycopg.Cursor, "execute", bomb.stepping)
                try:
                    tail(log, targets, SETTINGS, once=True, on_trouble=troubles.append)
                except DatabaseUnavailable as error:  # at the tail's very start
                    troubles.append(str(error))
                    targets.restart_embedded()
                    tail(log, targets, SETTINGS, once=True)
            assert all_rows(targets) == expected
            if bomb.left >= 0:
                break
            assert troubles
            killed += 1
    assert killed >= 1


class ServerBomb:
    """Kills the server before the ``at``-th statement that is sent."""

    def __init__(self, server: EmbeddedServer, at: int, execute: Any) -> None:
        self.left = at
        self.stepping = self._step(server, execute)

    def _step(self, server: EmbeddedServer, execute: Any) -> Any:
        def step(cursor: Any, *args: Any, **kwargs: Any) -> Any:
            self.left -= 1
            if self.left == -1:
                with pytest.MonkeyPatch.context() as unpatched:
                    unpatched.setattr(psycopg.Cursor, "execute", execute)
                    kill_postgres(server)
            return execute(cursor, *args, **kwargs)

        return step
