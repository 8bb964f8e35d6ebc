"""The old map is dropped by the server after a swap, if need be by the next rebuild."""

import sys
from functools import partial
from pathlib import Path

import psycopg
import pytest
from psycopg import sql

from projections.fold.map_errors import DatabaseError
from projections.fold.settings import Settings
from projections.postgres import RebuildProgress, rebuild
from projections.postgres.check import check
from projections.postgres.connection import Connection, Targets, connect
from projections.postgres.replaced_tables import try_drop_lock
from projections.postgres.vector_sink import build_hnsw
from tests.support.logs import walk, write_log
from tests.support.rows import all_rows, wait_for_drops

SETTINGS = Settings()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", walk(60))


def left_over(pg: psycopg.Connection) -> set[str]:
    """Schemas of replaced and unfinished maps."""
    rows = pg.execute(
        "SELECT nspname FROM pg_namespace"
        " WHERE nspname IN ('semantic_map_old', 'semantic_map_next', 'mapfold_old')"
    ).fetchall()
    return {name for (name,) in rows}


def skip_the_drop(connection: Connection, statement: sql.Composed) -> None:
    """Simulates a server that was stopped before it dropped anything."""
    connection.close()


def test_nothing_is_left_after_the_drop(
    log: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    for until in (30, None):
        rebuild(log, one_database, SETTINGS, until=until)
    wait_for_drops(one_database)
    assert left_over(pg) == set()


@pytest.mark.slow
def test_the_next_rebuild_drops_what_the_server_did_not(
    log: Path, one_database: Targets, pg: psycopg.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    rebuild(log, one_database, SETTINGS, until=30)
    with monkeypatch.context() as patched:
        patched.setattr("projections.postgres.replaced_tables.send_and_close", skip_the_drop)
        rebuild(log, one_database, SETTINGS)
    rows = all_rows(one_database)
    assert left_over(pg) == {"semantic_map_old", "mapfold_old"}
    rebuild(log, one_database, SETTINGS)
    wait_for_drops(one_database)
    assert left_over(pg) == set()
    assert all_rows(one_database) == rows


@pytest.mark.slow
def test_a_rebuild_waits_for_a_drop_only_before_its_swap(log: Path, one_database: Targets) -> None:
    rebuild(log, one_database, SETTINGS, until=30)
    wait_for_drops(one_database)
    dropping = connect(one_database.graph_url, autocommit=True)
    assert try_drop_lock(dropping, "graph")
    assert try_drop_lock(dropping, "vectors")
    seen: list[str] = []

    def on_progress(at: RebuildProgress) -> None:
        seen.append(at.stage)
        if at.stage == "swapping":
            dropping.close()

    rebuild(log, one_database, SETTINGS, progress=on_progress)
    assert "tidying" in seen
    assert dropping.closed


def test_a_foreign_schema_under_our_name_is_refused(
    log: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    pg.execute("CREATE SCHEMA mapfold_old")
    with pytest.raises(DatabaseError, match="schema mapfold_old that mapfold did not make"):
        rebuild(log, one_database, SETTINGS)
    assert left_over(pg) == {"mapfold_old"}


@pytest.mark.slow
def test_an_error_after_the_swap_says_that_the_new_map_is_in_place(
    log: Path, one_database: Targets, pg: psycopg.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    pg.execute("CREATE TABLE public.taken (n int)")
    pg.execute("CREATE INDEX detection_embeddings_halves ON public.taken (n)")
    for_any_table = partial(build_hnsw, threshold=1)
    monkeypatch.setattr(sys.modules["projections.postgres.shadows"], "build_hnsw", for_any_table)
    with pytest.raises(DatabaseError, match="already exists; the new map is in place"):
        rebuild(log, one_database, SETTINGS)
    assert [r.differing for r in check(log, one_database, SETTINGS)] == [0, 0]
    pg.execute("DROP TABLE public.taken")
    report = rebuild(log, one_database, SETTINGS)
    assert report.hnsw is not None
    assert report.hnsw.built
    assert report.hnsw.reason == f"HNSW index over {report.rows['detection_embeddings']} rows"
