"""Servers with other defaults: schemas, timeouts, output formats, an owner who is no superuser."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import psycopg
import pytest
from psycopg import sql

from projections.fold.map_errors import DatabaseError
from projections.fold.settings import Settings
from projections.postgres import RebuildProgress, rebuild, tail
from projections.postgres import data_folder as _cluster
from projections.postgres.check import check
from projections.postgres.connection import Targets, connect, pin_session_settings
from projections.postgres.embedded import EmbeddedServer
from projections.postgres.replaced_tables import roles_sql
from projections.postgres.status import projection_status
from tests.support.logs import walk, write_log
from tests.support.rows import all_rows, wait_for_drops
from tests.support.servers import server_to_kill
from tests.support.thorough import mostly_slow

pytestmark = pytest.mark.usefixtures("server_roles")

SETTINGS = Settings()
PAGE = Path(__file__).resolve().parents[2] / "docs" / "projections.md"
TIMEOUTS = (
    "SELECT name FROM pg_settings WHERE name ~"
    " '^(statement|lock|transaction|idle_session|idle_in_transaction_session)_timeout$'"
)
KEEPALIVES = {"keepalives_idle": "20", "keepalives_interval": "10", "keepalives_count": "3"}
HOST = "127.0.0.77"  # where no other server has port 5432
OWNER, WRITER = "an_owner", "a_tail"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", walk(40))


@pytest.fixture
def bare(bare_pg_url: str) -> Iterator[psycopg.Connection]:
    """A superuser's autocommit connection to a database without our extensions."""
    with psycopg.connect(bare_pg_url, autocommit=True) as connection:
        yield connection


def as_user(url: str, user: str) -> Targets:
    """The same database for another user."""
    theirs = url.replace(f"//{urlsplit(url).username}", f"//{user}", 1)
    return Targets(theirs, theirs)


@pytest.mark.slow
def test_pgvector_in_a_schema_of_its_own(
    log: Path, bare: psycopg.Connection, bare_pg_url: str
) -> None:
    """The fold makes rows before the thread that sends them has found the type."""
    bare.execute("CREATE SCHEMA elsewhere")
    bare.execute("CREATE EXTENSION vector WITH SCHEMA elsewhere")
    targets = Targets(bare_pg_url, bare_pg_url)
    rebuild(log, targets, SETTINGS, until=30)
    assert tail(log, targets, SETTINGS, once=True).events == 10
    assert [r.differing for r in check(log, targets, SETTINGS)] == [0, 0]


def test_short_default_timeouts(log: Path, one_database: Targets, pg: psycopg.Connection) -> None:
    """A rebuild's session idles in its transaction for as long as the fold takes."""
    database = sql.Identifier(pg.info.dbname)
    for (name,) in pg.execute(TIMEOUTS).fetchall():
        alter = sql.SQL("ALTER DATABASE {} SET {} = '250ms'")
        pg.execute(alter.format(database, sql.Identifier(name)))

    def idle(at: RebuildProgress) -> None:
        if at.stage == "swapping":
            pg.execute("SELECT pg_sleep(0.4)")  # a session from before

    rebuild(log, one_database, SETTINGS, until=30, progress=idle)
    assert tail(log, one_database, SETTINGS, once=True).events == 10
    assert [r.differing for r in check(log, one_database, SETTINGS)] == [0, 0]


@pytest.mark.parametrize(
    "setting",
    mostly_slow(
        [
            "extra_float_digits = 0",
            "client_encoding = 'LATIN1'",
            "search_path = ''",
            "default_transaction_isolation = 'serializable'",
            "datestyle = 'German'",
            "array_nulls = off",
            "timezone = 'Asia/Kathmandu'",
            "standard_conforming_strings = off",
        ]
    ),
)
def test_output_formats_of_the_server_change_no_value(
    log: Path, one_database: Targets, pg: psycopg.Connection, setting: str
) -> None:
    rebuild(log, one_database, SETTINGS)
    rows = all_rows(one_database)
    database = sql.Identifier(pg.info.dbname)
    pg.execute(sql.SQL("ALTER DATABASE {} SET ").format(database) + sql.SQL(setting))  # type: ignore[arg-type]
    rebuild(log, one_database, SETTINGS, until=5)
    assert tail(log, one_database, SETTINGS, once=True, batch_events=30).events == 35
    assert [r.differing for r in check(log, one_database, SETTINGS)] == [0, 0]
    assert projection_status(log, one_database, SETTINGS).healthy
    pg.execute(sql.SQL("ALTER DATABASE {} RESET ALL").format(database))
    assert all_rows(one_database) == rows


def test_a_database_that_is_not_in_utf8_is_refused(log: Path, pg_server: EmbeddedServer) -> None:
    name = f"latin_{os.getpid()}"
    with connect(pg_server.url, autocommit=True) as admin:
        admin.execute(
            sql.SQL(
                "CREATE DATABASE {} TEMPLATE template0 ENCODING 'LATIN1'"
                " LOCALE_PROVIDER libc LC_COLLATE 'C' LC_CTYPE 'C'"
            ).format(sql.Identifier(name))
        )
        targets = Targets(pg_server.url_of(name), pg_server.url_of(name))
        try:
            with pytest.raises(
                DatabaseError, match=r"encoding is LATIN1.* createdb --encoding UTF8"
            ):
                rebuild(log, targets, SETTINGS)
        finally:
            admin.execute(sql.SQL("DROP DATABASE {}").format(sql.Identifier(name)))


def test_a_vanished_peer_is_noticed_within_a_minute(
    pg_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By both sides; only so does a writer's lock come back when its machine has lost power."""
    settings = {**_cluster.SETTINGS, "listen_addresses": HOST}  # a unix socket knows no such thing
    monkeypatch.setattr(_cluster, "SETTINGS", settings)
    with server_to_kill(), connect(f"postgresql://postgres@{HOST}/postgres") as connection:
        pin_session_settings(connection)
        for name, wanted in KEEPALIVES.items():
            row = connection.execute("SELECT current_setting(%s)", [f"tcp_{name}"]).fetchone()
            assert row == (wanted,)
            assert connection.info.get_parameters()[name] == wanted
        assert connection.info.get_parameters()["tcp_user_timeout"] == "50000"
    with connect(f"{pg_url}{'&' if '?' in pg_url else '?'}keepalives_idle=7") as connection:
        assert connection.info.get_parameters()["keepalives_idle"] == "7"


@pytest.fixture
def owned(pg_server: EmbeddedServer) -> Iterator[str]:
    """URL of a database that goes before the roles that own things in it."""
    name = sql.Identifier(f"owned_{os.getpid()}")
    with connect(pg_server.url, autocommit=True) as admin:
        admin.execute(sql.SQL("CREATE DATABASE {} TEMPLATE template0").format(name))
        yield pg_server.url_of(name.as_string(None).strip('"'))
        admin.execute(sql.SQL("DROP DATABASE {} WITH (FORCE)").format(name))
        for role in (OWNER, WRITER, "mapfold_writer", "mapfold_reader"):
            admin.execute(sql.SQL("DROP ROLE IF EXISTS {}").format(sql.Identifier(role)))


@pytest.fixture
def superuser(owned: str) -> Iterator[psycopg.Connection]:
    """Has done what docs/projections.md has a superuser do for an owner who is none."""
    text = PAGE.read_text("utf-8")
    found = re.search(r"^    GRANT CREATE ON DATABASE postgres .*\n(    .*\n)+", text, re.MULTILINE)
    assert found is not None
    with psycopg.connect(owned, autocommit=True) as connection:
        connection.execute(sql.SQL("CREATE ROLE {} LOGIN").format(sql.Identifier(OWNER)))
        told = found[0].replace("DATABASE postgres", f"DATABASE {connection.info.dbname}")
        connection.execute(re.sub(r"\bme\b", OWNER, told))  # type: ignore[arg-type]
        yield connection


@pytest.mark.slow
@pytest.mark.usefixtures("superuser")
def test_an_owner_who_is_no_superuser(log: Path, owned: str) -> None:
    owner = as_user(owned, OWNER)
    for until in (20, 30):
        rebuild(log, owner, SETTINGS, until=until)
        wait_for_drops(owner)
    assert tail(log, owner, SETTINGS, once=True).events == 10
    assert [r.differing for r in check(log, owner, SETTINGS)] == [0, 0]
    assert projection_status(log, owner, SETTINGS).healthy
    with connect(owner.graph_url) as connection:
        names = connection.execute("SELECT name::text FROM ag_catalog.ag_graph").fetchall()
    assert names == [("semantic_map",)]


@pytest.mark.slow
def test_a_writer_cannot_change_the_dimension_and_names_who_can(
    tmp_path: Path, superuser: psycopg.Connection, owned: str
) -> None:
    owner, writer = as_user(owned, OWNER), as_user(owned, WRITER)
    log = write_log(tmp_path / "log", [])
    rebuild(log, owner, SETTINGS)
    superuser.execute(roles_sql())  # type: ignore[arg-type]
    create = sql.SQL("CREATE ROLE {} LOGIN IN ROLE mapfold_writer")
    superuser.execute(create.format(sql.Identifier(WRITER)))
    write_log(log, walk(10))
    with pytest.raises(DatabaseError, match=r"8 dimensions, .* for 512, .* `mapfold replay`"):
        tail(log, writer, SETTINGS, once=True)
    rebuild(log, owner, SETTINGS)
    rows = all_rows(owner)
    write_log(log, walk(5, first=10))
    assert tail(log, writer, SETTINGS, once=True).events == 5
    assert len(all_rows(owner)[0]["Keyframe"]) == len(rows[0]["Keyframe"]) + 5
