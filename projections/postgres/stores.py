"""The databases of a run and the sinks in each; sinks in one database commit together."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import psycopg

from projections.fold.map_errors import DatabaseError
from projections.fold.settings import Settings

from . import checkpoints
from .connection import (
    Connection,
    Targets,
    connect,
    database_errors,
    describe_target,
    pin_session_settings,
)
from .graph_sink import GraphSink
from .labels import SinkName
from .vector_sink import VectorSink

Only: TypeAlias = SinkName | None
"""The one sink to write, None for all."""
DatabaseSink: TypeAlias = GraphSink | VectorSink


@dataclass(slots=True)
class Store:
    """One database: its open autocommit connection and the sinks that are written through it."""

    url: str
    application: str
    sinks: tuple[DatabaseSink, ...]
    connection: Connection

    @property
    def place(self) -> str:
        """The database, for messages."""
        return describe_target(self.url)

    def reconnect(self) -> None:
        """Replace a lost connection and take the sinks' locks again."""
        self.connection.close()
        self.connection = _open(self.url, self.application, self.sinks)

    @contextlib.contextmanager
    def throwaway_connection(self) -> Iterator[Connection]:
        """A second connection, closed afterwards, for dropping graphs.

        AGE 1.5 keeps labels of a dropped graph in the session's cache and may end the session over
        them later.
        """
        opened = connect(self.url, application=self.application, autocommit=True)
        with opened as connection, database_errors(self.url):
            connection.execute("SET client_min_messages = warning")
            pin_session_settings(connection)
            yield connection

    def run(self, job: Callable[[Connection], None]) -> None:
        """Call ``job`` with the connection. Raises DatabaseError that names this database."""
        with database_errors(self.url):
            job(self.connection)

    def close(self) -> None:
        """Close the connection, which releases the locks."""
        self.connection.close()


@contextlib.contextmanager
def open_stores(
    targets: Targets,
    settings: Settings,
    *,
    only: Only,
    application: str,
    remake: bool = False,
) -> Iterator[list[Store]]:
    """The stores of ``targets``, each sink's writer lock held. Raises ProjectionBusy, and
    ProjectionMismatch for those of another version, which are dropped to ``remake`` them."""
    stores: list[Store] = []
    try:
        for url, sinks in _sinks_by_url(targets, settings, only).items():
            stores.append(Store(url, application, sinks, _open(url, application, sinks, remake)))
        yield stores
    finally:
        for store in stores:
            store.close()


def _sinks_by_url(
    targets: Targets, settings: Settings, only: Only
) -> dict[str, tuple[DatabaseSink, ...]]:
    found: dict[str, tuple[DatabaseSink, ...]] = {}
    for sink in (GraphSink(), VectorSink(dimension=settings.embedding_dim)):
        if only in (None, sink.name):
            url = targets.url_of(sink.name)
            found[url] = (*found.get(url, ()), sink)
    return found


def _open(
    url: str, application: str, sinks: tuple[DatabaseSink, ...], remake: bool = False
) -> Connection:
    connection = connect(url, application=application, autocommit=True)
    try:
        _refuse_encoding(connection, url)
        with database_errors(url):
            # AGE and schema commands send notices.
            connection.execute("SET client_min_messages = warning")
            pin_session_settings(connection)
            for sink in sinks:
                checkpoints.lock_writer(connection, sink.name)
            if remake:
                checkpoints.drop_other_version(connection)
            _ensure_schema(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def _refuse_encoding(connection: Connection, url: str) -> None:
    encoding = connection.info.parameter_status("server_encoding")
    if encoding not in ("UTF8", "SQL_ASCII"):
        raise DatabaseError(
            f"{describe_target(url)}: its encoding is {encoding}, which cannot hold every name in"
            " a log; make a database with createdb --encoding UTF8 --template template0"
        )


def _ensure_schema(connection: Connection) -> None:
    try:
        with connection.transaction():
            checkpoints.ensure_schema(connection)
    except (psycopg.errors.DuplicateSchema, psycopg.errors.UniqueViolation):
        pass  # another service created it at the same moment
