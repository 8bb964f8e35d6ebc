"""One embedded server and one template for a whole test run; a fresh database for each test."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit, urlunsplit

import psycopg
import pytest
from psycopg import sql

from projections.postgres.connection import Targets, connect, ensure_extension
from projections.postgres.embedded import EmbeddedServer
from tests.support.servers import CARELESS, MEMORY_DISK, RUN_HOME, hold_run, remove_killed_runs
from tests.support.thorough import mostly_slow

_TEMPLATE = "mapfold_test_template"
_numbers = count()


class OtherServer(EmbeddedServer):
    """The server that MAPFOLD_TEST_DB names, a superuser's URL: to test against other versions."""

    def __init__(self, url: str) -> None:
        self._url = url

    def url_of(self, database: str) -> str:
        """URL of one of its databases."""
        return _url_with_database(self._url, database)


def _url_with_database(url: str, database: str) -> str:
    """``url`` with another database."""
    parts = urlsplit(url)
    return urlunsplit(parts._replace(path=f"/{database}"))


@pytest.fixture(scope="session")
def pg_server() -> Iterator[EmbeddedServer]:
    """A running server of this test run's own, shared by its workers; the last one stops it."""
    if "MAPFOLD_TEST_DB" in os.environ:
        yield OtherServer(os.environ["MAPFOLD_TEST_DB"])
        return
    with EmbeddedServer(RUN_HOME) as server:
        with connect(server.url, autocommit=True) as connection:
            for each, value in CARELESS.items():
                connection.execute(
                    sql.SQL("ALTER SYSTEM SET {} = {}").format(sql.Identifier(each), value)
                )
            connection.execute("SELECT pg_reload_conf()")
        yield server


_held: list[IO[bytes]] = []


def pytest_sessionstart() -> None:
    """Mark the run's folder as in use; remove those of killed runs, once a run."""
    _held.append(hold_run(RUN_HOME))
    if "PYTEST_XDIST_WORKER" not in os.environ:
        for parent in {RUN_HOME.parent, MEMORY_DISK, Path(tempfile.gettempdir())}:
            remove_killed_runs(parent)


@pytest.hookimpl(trylast=True)  # behind xdist's, which waits for the workers
def pytest_sessionfinish() -> None:
    """Remove the server's folder at the end of the run, when all workers have left it."""
    while _held:
        _held.pop().close()
    if "PYTEST_XDIST_WORKER" not in os.environ:
        shutil.rmtree(RUN_HOME, ignore_errors=True)


@pytest.fixture(scope="session")
def _template(pg_server: EmbeddedServer) -> str:
    """A database with both extensions, made by the first worker that needs it."""
    with connect(pg_server.url, autocommit=True) as connection:
        connection.execute("SELECT pg_advisory_lock(hashtext(%s))", [_TEMPLATE])
        found = connection.execute("SELECT FROM pg_database WHERE datname = %s", [_TEMPLATE])
        if found.fetchone() is None:
            name = sql.Identifier(_TEMPLATE)
            connection.execute(sql.SQL("CREATE DATABASE {}").format(name))
            with connect(pg_server.url_of(_TEMPLATE), autocommit=True) as inside:
                ensure_extension(inside, "age")
                ensure_extension(inside, "vector")
    return _TEMPLATE


def _fresh_database(server: EmbeddedServer, template: str) -> str:
    name = f"test_{os.getpid()}_{next(_numbers)}"
    with connect(server.url, autocommit=True) as connection:
        connection.execute(
            # Copying files costs a third of logging every page.
            sql.SQL("CREATE DATABASE {} TEMPLATE {} STRATEGY FILE_COPY").format(
                sql.Identifier(name), sql.Identifier(template)
            )
        )
    return name


def _drop_database(server: EmbeddedServer, name: str) -> None:
    with connect(server.url, autocommit=True) as connection:
        connection.execute(sql.SQL("DROP DATABASE {} WITH (FORCE)").format(sql.Identifier(name)))


@pytest.fixture
def server_roles(pg_server: EmbeddedServer) -> Iterator[None]:
    """Keep other workers' tests from making roles, which belong to the whole server."""
    with connect(pg_server.url, autocommit=True) as connection:
        connection.execute("SELECT pg_advisory_lock(hashtext('roles'))")
        yield


@pytest.fixture
def pg_url(pg_server: EmbeddedServer, _template: str) -> Iterator[str]:
    """URL of a database with both extensions and nothing else, dropped after the test."""
    name = _fresh_database(pg_server, _template)
    yield pg_server.url_of(name)
    _drop_database(pg_server, name)


@pytest.fixture(scope="module")
def module_database(pg_server: EmbeddedServer, _template: str) -> Iterator[Targets]:
    """Graph and vectors in one database for all tests of a module, which may only read it."""
    name = _fresh_database(pg_server, _template)
    yield Targets(pg_server.url_of(name), pg_server.url_of(name))
    _drop_database(pg_server, name)


@pytest.fixture
def bare_pg_url(pg_server: EmbeddedServer) -> Iterator[str]:
    """URL of a database without our extensions."""
    name = _fresh_database(pg_server, "template0")
    yield pg_server.url_of(name)
    _drop_database(pg_server, name)


@pytest.fixture
def one_database(pg_url: str) -> Targets:
    """Graph and vectors in one fresh database."""
    return Targets(pg_url, pg_url)


@pytest.fixture
def two_databases(pg_server: EmbeddedServer, _template: str, pg_url: str) -> Iterator[Targets]:
    """Graph and vectors in a fresh database each."""
    name = _fresh_database(pg_server, _template)
    yield Targets(pg_url, pg_server.url_of(name))
    _drop_database(pg_server, name)


@pytest.fixture(params=mostly_slow(["two_databases", "one_database"]))
def targets(request: pytest.FixtureRequest) -> Targets:
    """Graph and vectors in two fresh databases, and again in one."""
    found: Targets = request.getfixturevalue(request.param)
    return found


@pytest.fixture
def third_database(pg_server: EmbeddedServer, _template: str) -> Iterator[Targets]:
    """Graph and vectors in one more fresh database, beside those of ``two_databases``."""
    name = _fresh_database(pg_server, _template)
    yield Targets(pg_server.url_of(name), pg_server.url_of(name))
    _drop_database(pg_server, name)


@pytest.fixture
def pg(pg_url: str) -> Iterator[psycopg.Connection]:
    """An autocommit connection to this test's database, as a psql user would have it."""
    with psycopg.connect(pg_url, autocommit=True) as connection:
        connection.execute("LOAD 'age'")
        connection.execute('SET search_path = ag_catalog, "$user", public')
        yield connection
