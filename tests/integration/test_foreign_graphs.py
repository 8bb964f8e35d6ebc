"""A graph under our name that somebody else made: adopted if it is empty, else refused with the
statement that renames it."""

import re
from collections.abc import Callable
from pathlib import Path

import psycopg
import pytest

from projections.fold.map_errors import DatabaseError
from projections.fold.settings import Settings
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from tests.support.logs import bridge, walk, write_log
from tests.support.rows import all_rows
from tests.support.thorough import mostly_slow

SETTINGS = Settings()
LABELS = "SELECT create_vlabel('semantic_map', 'Robot'), create_elabel('semantic_map', 'SAW')"
VERTEX = """SELECT * FROM cypher('semantic_map', $$ CREATE (:Robot {n: 1}) $$) AS (v agtype)"""

Act = Callable[[Path, Targets], object]


def by_replay(log: Path, targets: Targets) -> object:
    return rebuild(log, targets, SETTINGS)


def by_tail(log: Path, targets: Targets) -> object:
    return tail(log, targets, SETTINGS, once=True)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("foreign") / "log", walk(30) + list(bridge()))


@pytest.fixture(scope="module")
def rows(log: Path, module_database: Targets) -> object:
    """What a database holds where there was no graph before."""
    rebuild(log, module_database, SETTINGS)
    return all_rows(module_database)


def make(pg: psycopg.Connection, *statements: str) -> None:
    for statement in ("SELECT create_graph('semantic_map')", *statements):
        pg.execute(statement)  # type: ignore[arg-type]
    pg.commit()


@pytest.mark.seconds
@pytest.mark.parametrize(
    ("labels", "act"),
    mostly_slow([((LABELS,), by_replay), ((), by_tail), ((LABELS,), by_tail), ((), by_replay)]),
)
def test_an_empty_graph_is_adopted(
    log: Path,
    rows: object,
    one_database: Targets,
    labels: tuple[str, ...],
    act: Act,
) -> None:
    with psycopg.connect(one_database.graph_url) as pg:
        pg.execute("SET search_path = ag_catalog, public")
        make(pg, *labels)
    act(log, one_database)
    assert all_rows(one_database) == rows
    assert [report.sound for report in check(log, one_database, SETTINGS)] == [True, True]
    act(log, one_database)
    assert all_rows(one_database) == rows


def test_rights_on_an_empty_graph_are_kept(log: Path, one_database: Targets) -> None:
    with psycopg.connect(one_database.graph_url) as pg:
        pg.execute("SET search_path = ag_catalog, public")
        make(pg, "GRANT USAGE ON SCHEMA semantic_map TO PUBLIC")
    rebuild(log, one_database, SETTINGS)
    tail(log, one_database, SETTINGS, once=True)
    with psycopg.connect(one_database.graph_url) as pg:
        row = pg.execute("SELECT nspacl::text FROM pg_namespace WHERE nspname = 'semantic_map'")
        assert "=U/" in str(row.fetchone())


@pytest.mark.parametrize("act", mostly_slow([by_replay, by_tail]))
@pytest.mark.parametrize(
    "statements",
    [
        ("SELECT create_graph('semantic_map')", LABELS, VERTEX),
        ("SELECT create_graph('semantic_map')", "CREATE TABLE semantic_map.mine AS SELECT 1 AS n"),
        ("SELECT create_graph('semantic_map')", "COMMENT ON SCHEMA semantic_map IS 'of Ann'"),
        ("CREATE SCHEMA semantic_map", "CREATE SCHEMA semantic_map_1"),
    ],
    ids=["vertex", "table", "comment", "schema"],
)
def test_what_is_not_empty_is_refused_and_the_statement_renames_it(
    log: Path, one_database: Targets, statements: tuple[str, ...], act: Act
) -> None:
    with psycopg.connect(one_database.graph_url) as pg:
        pg.execute("LOAD 'age'")
        pg.execute("SET search_path = ag_catalog, public")
        for statement in statements:
            pg.execute(statement)  # type: ignore[arg-type]
    with pytest.raises(DatabaseError, match="that mapfold did not make; rename it by `") as told:
        act(log, one_database)
    (sql,) = re.findall(r"`([^`]*)`", str(told.value))
    with psycopg.connect(one_database.graph_url) as pg:  # a session that knows nothing of AGE
        pg.execute(sql)
    act(log, one_database)
    assert [report.sound for report in check(log, one_database, SETTINGS)] == [True, True]
    with psycopg.connect(one_database.graph_url) as pg:
        names = pg.execute("SELECT nspname::text FROM pg_namespace WHERE nspname ~ '^semantic_'")
        new_name = re.findall(r"semantic_map_\d", sql)[0]
        assert {new_name, "semantic_map"} <= {name for (name,) in names}
        if "cypher" in statements[-1]:
            pg.execute("LOAD 'age'")
            found = pg.execute(
                f"SELECT * FROM ag_catalog.cypher('{new_name}', $$ MATCH (r:Robot) RETURN r.n $$)"  # type: ignore[arg-type]
                " AS (n ag_catalog.agtype)"
            )
            assert found.fetchall() == [("1",)]
