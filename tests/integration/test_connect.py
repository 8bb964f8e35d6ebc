"""Which database a command uses, and the one-line errors of databases."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from eventsrc.base.errors import MisuseError
from projections.fold.map_errors import DatabaseUnavailable, ExtensionMissing
from projections.postgres.connection import (
    Targets,
    connect,
    describe_target,
    ensure_extension,
    open_targets,
)
from projections.postgres.cypher import connect_for_cypher
from projections.postgres.embedded import EmbeddedServer
from projections.postgres.queries.candidate_search import CandidateReader


@pytest.fixture(autouse=True)
def _no_urls_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MAPFOLD_DB", raising=False)
    monkeypatch.delenv("MAPFOLD_VECTOR_DB", raising=False)


A = "postgresql://u@host/a"
B = "postgresql://u@host/b"
C = "postgresql://u@host/c"


def test_vectors_go_where_the_graph_goes() -> None:
    with open_targets(A) as targets:
        assert (targets.graph_url, targets.vector_url) == (A, A)
        assert targets.one_database


def test_two_databases() -> None:
    with open_targets(A, B) as targets:
        assert (targets.graph_url, targets.vector_url) == (A, B)
        assert not targets.one_database


def test_options_override_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAPFOLD_DB", A)
    monkeypatch.setenv("MAPFOLD_VECTOR_DB", B)
    with open_targets() as targets:
        assert (targets.graph_url, targets.vector_url) == (A, B)
    with open_targets(C) as targets:
        assert (targets.graph_url, targets.vector_url) == (C, B)


@pytest.mark.parametrize(
    "url", ["nonsense", "mysql://u:secret@host/db", "postgresql://u:secret@host/db?no_such=1"]
)
def test_a_bad_url_is_misuse_and_shows_no_password(url: str) -> None:
    with pytest.raises(MisuseError, match="not a PostgreSQL URL") as caught, open_targets(url):
        pass
    assert "secret" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_a_server_that_is_down() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, not listening: connections are refused
        url = f"postgresql://u:secret@127.0.0.1:{taken.getsockname()[1]}/db"
        with pytest.raises(DatabaseUnavailable, match="refused") as caught:
            connect(url)
    message = str(caught.value)
    assert "\n" not in message
    assert "secret" not in message
    assert "database db at 127.0.0.1" in message


def test_errors_of_the_embedded_server_do_not_mention_urls(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAPFOLD_HOME", str(tmp_path))
    with pytest.raises(DatabaseUnavailable, match=r"server went away; .*server\.log") as no:
        connect(EmbeddedServer(tmp_path).url)
    assert "--db" not in str(no.value)


CUT = """
import sys
from projections.postgres.connection import connect, database_errors
from projections.fold.map_errors import DatabaseUnavailable
url = sys.argv[1]
with connect(url, autocommit=True) as killer, connect(url) as connection:
    try:
        with database_errors(url), connection.pipeline():
            connection.execute("SELECT 1")
            killer.execute("SELECT pg_terminate_backend(%s, 10000)", [connection.info.backend_pid])
            connection.execute("SELECT 2")
    except DatabaseUnavailable as error:
        print(error)
"""


def test_a_lost_connection_is_reported_once(pg_url: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CUT, pg_url], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert done.stdout.count("\n") == 1
    assert done.stdout.startswith("database ")


def test_a_missing_database(pg_server: EmbeddedServer) -> None:
    with pytest.raises(DatabaseUnavailable, match=r'"nowhere" does not exist; create it with'):
        connect(pg_server.url_of("nowhere"))


def test_a_missing_database_of_the_embedded_server(
    pg_server: EmbeddedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAPFOLD_HOME", str(pg_server.data.parent))
    with pytest.raises(DatabaseUnavailable, match=r'"nowhere" does not exist; create it with'):
        connect(pg_server.url_of("nowhere"))


def test_a_missing_user(pg_server: EmbeddedServer) -> None:
    url = pg_server.url.replace("postgres@", "stranger@")
    with pytest.raises(DatabaseUnavailable, match=r"stranger.*does not exist; create it with"):
        connect(url)


def test_extensions_are_created_once_and_their_version_returned(bare_pg_url: str) -> None:
    with connect(bare_pg_url) as connection:
        assert ensure_extension(connection, "vector") == ensure_extension(connection, "vector")
        assert ensure_extension(connection, "age").startswith("1.")


def test_an_extension_the_server_does_not_have(bare_pg_url: str) -> None:
    with (
        connect(bare_pg_url) as connection,
        pytest.raises(ExtensionMissing, match=r"install the extension no_such_thing") as caught,
    ):
        ensure_extension(connection, "no_such_thing")
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("server_roles")
def test_a_user_who_may_not_create_extensions(pg_server: EmbeddedServer, bare_pg_url: str) -> None:
    with connect(bare_pg_url, autocommit=True) as connection:
        connection.execute("DROP ROLE IF EXISTS nobody_special")
        connection.execute("CREATE ROLE nobody_special LOGIN")
    with (
        connect(bare_pg_url.replace("postgres@", "nobody_special@")) as connection,
        pytest.raises(ExtensionMissing, match="have a superuser run CREATE EXTENSION age"),
    ):
        ensure_extension(connection, "age")


@pytest.fixture
def ordinary_url(pg_url: str) -> Iterator[str]:
    """This test's database as a role without any privilege of its own."""
    with connect(pg_url, autocommit=True) as admin:
        admin.execute("DROP ROLE IF EXISTS ordinary")
        admin.execute("CREATE ROLE ordinary LOGIN")
        yield pg_url.replace("postgres@", "ordinary@")
        admin.execute("DROP OWNED BY ordinary")
        admin.execute("DROP ROLE ordinary")


def test_cypher_without_being_superuser(pg: psycopg.Connection, ordinary_url: str) -> None:
    with pytest.raises(ExtensionMissing, match="GRANT USAGE ON SCHEMA ag_catalog"):
        connect_for_cypher(ordinary_url)
    pg.execute("GRANT USAGE ON SCHEMA ag_catalog TO ordinary")
    pg.execute("SELECT create_graph('some_graph')")
    pg.execute("GRANT USAGE ON SCHEMA some_graph TO ordinary")
    pg.execute("GRANT SELECT ON ALL TABLES IN SCHEMA ag_catalog TO ordinary")
    with connect_for_cypher(ordinary_url) as connection:
        rows = connection.execute(
            "SELECT * FROM cypher('some_graph', $$ RETURN 7 $$) AS (n agtype)"
        ).fetchall()
    assert rows == [("7",)]


def test_cypher_without_the_extension(bare_pg_url: str) -> None:
    with pytest.raises(ExtensionMissing, match="age is not created there"):
        connect_for_cypher(bare_pg_url)


def test_a_question_to_a_database_without_a_projection(bare_pg_url: str) -> None:
    with pytest.raises(
        ExtensionMissing, match=r"nothing has been projected .*; run `mapfold replay`"
    ):
        CandidateReader(Targets(bare_pg_url, bare_pg_url))


def test_a_described_target_has_no_password() -> None:
    assert describe_target("postgresql://u:secret@h:5433/maps") == "database maps at h:5433"


def test_the_embedded_server_is_the_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pg_server: EmbeddedServer
) -> None:
    monkeypatch.setenv("MAPFOLD_HOME", str(pg_server.home))
    with open_targets() as targets:
        assert targets.one_database
        with connect(targets.graph_url) as connection:
            assert connection.execute("SELECT 1").fetchone() == (1,)
    assert pg_server.running
