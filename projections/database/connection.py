"""From what the user said to connections: which databases, and a clear word when one fails.

The graph and the vectors may share one database (the default) or live in two. Where they are:
``--db`` and ``--vector-db``, else MAPFOLD_DB and MAPFOLD_VECTOR_DB, else the embedded server. The
vectors go where the graph goes unless told otherwise.

Messages name host, port and database, never a password, and nothing of a URL that cannot be parsed.
"""

import contextlib
import json
import logging
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, LiteralString

import psycopg
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict, make_conninfo
from psycopg.rows import TupleRow

from eventsrc.errors import MisuseError
from projections.errors import DatabaseError, DatabaseUnavailable, ExtensionMissing

from .embedded import EmbeddedServer, embedded_log

Connection = psycopg.Connection[TupleRow]

# What goes wrong comes as an exception and is told once, in our words. Without a handler Python
# would print what psycopg and its pool log about it too.
logging.getLogger("psycopg").addHandler(logging.NullHandler())

CONNECT_SECONDS: Final = 10
_LINK: Final[Mapping[str, int]] = {
    "keepalives_idle": 20,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    "tcp_user_timeout": 50_000,
}
"""A server that went without a word (its power, the network) is missed within a minute; by default
that takes hours. What the URL says of it wins."""
_SESSION: Final[Mapping[str, str]] = {
    "statement_timeout": "0",
    "lock_timeout": "0",
    "idle_in_transaction_session_timeout": "0",
    "transaction_timeout": "0",  # from PostgreSQL 17 on
    "idle_session_timeout": "0",
    # How values are written, which a server's owner may have set for people to read.
    "DateStyle": "ISO",
    "extra_float_digits": "1",
    "array_nulls": "on",
    # From the server's side: a writer that went without a word gives its lock back.
    "tcp_keepalives_idle": "20",
    "tcp_keepalives_interval": "10",
    "tcp_keepalives_count": "3",
}
_PUBLIC: Final = ("host", "port", "dbname", "user")
"""The parts of a URL that a message may show."""
_PACKAGES: Final[Mapping[str, str]] = {"age": "Apache AGE", "vector": "pgvector"}


@dataclass(frozen=True, slots=True)
class Targets:
    """The databases of one projection. ``embedded`` is ours to restart when it dies."""

    graph_url: str = field(repr=False)
    vector_url: str = field(repr=False)
    embedded: EmbeddedServer | None = None

    @property
    def one_database(self) -> bool:
        """True when both are written in one transaction."""
        return self.graph_url == self.vector_url

    def revive(self) -> None:
        """Start the embedded server again if it is ours and has died."""
        if self.embedded is not None:
            self.embedded.start()


@contextlib.contextmanager
def open_targets(db: str | None = None, vector_db: str | None = None) -> Iterator[Targets]:
    """The databases to use; the embedded server runs while the context is open, if it is needed."""
    graph_url = _given(db, "--db", "MAPFOLD_DB")
    vector_url = _given(vector_db, "--vector-db", "MAPFOLD_VECTOR_DB") or graph_url
    if graph_url is not None and vector_url is not None:
        yield Targets(graph_url, vector_url)
        return
    with EmbeddedServer() as server:
        yield Targets(graph_url or server.url, vector_url or server.url, server)


def _given(option: str | None, name: str, variable: str) -> str | None:
    """What an option or else an environment variable says, checked."""
    url, given_as = (option, name) if option else (os.environ.get(variable), variable)
    if not url:
        return None
    check_url(url, given_as)
    return url


def check_url(url: str, given_as: str = "the database's URL") -> None:
    """Refuse what is no PostgreSQL URL, before anything tries to connect.

    Nothing of it is shown, nor what libpq says of it, which quotes parts: what cannot be parsed may
    be a password anywhere. libpq itself takes ``//u:pa/ss@host`` for host ``u`` and port ``pa``.
    """
    if not _plain(url):
        raise MisuseError(
            f"{given_as}: not a PostgreSQL URL (not shown, it may hold a password); write it as"
            " postgresql://user:password@host:port/database, with %40 for @, %2F for / and %25 for"
            " % in user and password"
        )


def _plain(url: str) -> bool:
    """Whether libpq reads a URL, and reads it as a person would."""
    try:
        said = conninfo_to_dict(url)
    except (psycopg.Error, ValueError):  # ValueError: characters that have no UTF-8
        return False
    authority, _, path = url.partition("?")[0].partition("://")[2].partition("/")
    ports = [port for port in str(said.get("port") or "").split(",") if port]
    return (
        url.startswith(("postgresql://", "postgres://"))
        and "\0" not in url  # libpq would end there
        and all(str(said.get(name) or "").isprintable() for name in _PUBLIC)
        and authority.count("@") <= 1
        and "@" not in path
        and all(re.fullmatch("[0-9]{1,5}", port) and 0 < int(port) < 65536 for port in ports)
    )


def connect(url: str, *, application: str = "mapfold", autocommit: bool = False) -> Connection:
    """A connection. Raises DatabaseUnavailable in one line that says what to do next."""
    check_url(url)
    said = conninfo_to_dict(url)
    missing = {name: value for name, value in _LINK.items() if name not in said}
    try:
        return psycopg.connect(
            # COPY data is made here, in UTF-8, whatever the server's owner prefers to read.
            make_conninfo(url, **missing, client_encoding="UTF8"),
            autocommit=autocommit,
            application_name=application,
            connect_timeout=CONNECT_SECONDS,
        )
    except psycopg.Error as error:  # also a value in the URL that libpq finds wrong only now
        told = f"{_without_values(_first_line(error), url)}; {_advice(error, url)}"
        raise DatabaseUnavailable(f"{describe_target(url)}: {told}") from None


def pin_session_settings(connection: Connection) -> None:
    """Let the session take its time and mean what it says, whatever is set for others there.

    A rebuild folds for minutes between two statements, an index of many vectors takes longer, and a
    tail may have nothing to say all night. But it ends when its client is no longer there.
    """
    connection.execute(
        "SELECT set_config(name, wanted ->> name, false)"
        " FROM pg_catalog.pg_settings, (SELECT %s::jsonb) AS w(wanted) WHERE wanted ? name",
        [json.dumps(_SESSION)],
    )


def ensure_extension(connection: Connection, name: LiteralString) -> str:
    """Create the extension ``age`` or ``vector`` if need be; returns its version."""
    version = extension_version(connection, name)
    if version is not None:
        return version
    where = describe_connection(connection)
    try:
        with connection.transaction():
            # Writing the graph puts ag_catalog first on the search path, and there the operators of
            # pgvector would be out of sight of everybody else. AGE itself fixes its own schema.
            schema = sql.SQL(" WITH SCHEMA public" if name == "vector" else "")
            connection.execute(
                sql.SQL("CREATE EXTENSION IF NOT EXISTS {}{}").format(sql.Identifier(name), schema)
            )
    except psycopg.errors.InsufficientPrivilege:
        raise ExtensionMissing(
            f"{where}: user {connection.info.user} may not create the extension {name}; have a"
            f" superuser run CREATE EXTENSION {name} there"
        ) from None
    except (psycopg.errors.UndefinedFile, psycopg.errors.FeatureNotSupported):
        raise ExtensionMissing(_missing(name, where)) from None
    except psycopg.errors.UniqueViolation:  # another session has just created it
        pass
    return extension_version(connection, name) or "unknown"


def extension_version(connection: Connection, name: str) -> str | None:
    """The installed version of an extension, None if the database has none."""
    row = connection.execute(
        "SELECT extversion FROM pg_catalog.pg_extension WHERE extname = %s", [name]
    ).fetchone()
    return None if row is None else str(row[0])


def describe_target(url: str) -> str:
    """Host, port and database of a URL or connection string: what a message may show."""
    try:
        parts = conninfo_to_dict(url)
    except psycopg.ProgrammingError:
        return "a database whose URL cannot be read"
    host = parts.get("host") or "local socket"
    port = parts.get("port") or 5432
    return f"database {parts.get('dbname') or parts.get('user') or 'default'} at {host}:{port}"


def describe_connection(connection: Connection) -> str:
    """The same for an open connection."""
    return describe_target(connection.info.dsn)


@contextlib.contextmanager
def database_errors(url: str) -> Iterator[None]:
    """Map what psycopg raises inside to our errors: one line, the place, the server's own words."""
    try:
        yield
    except psycopg.OperationalError as error:
        raise DatabaseUnavailable(
            f"{describe_target(url)}: {_first_line(error)}; {_advice(error, url)}"
        ) from error
    except psycopg.errors.InsufficientPrivilege as error:
        raise DatabaseError(
            f"{describe_target(url)}: {_first_line(error)}; grant it (docs/projections.md has the"
            " roles)"
        ) from error
    except psycopg.Error as error:
        raise DatabaseError(f"{describe_target(url)}: {_first_line(error)}") from error


def _missing(name: str, where: str) -> str:
    return (
        f"{where}: the server has no {_PACKAGES.get(name, name)}; install the extension {name} on"
        " it, or use docker/compose.yaml, or leave --db away for the embedded server"
    )


def _advice(error: psycopg.Error, url: str) -> str:
    text = str(error)
    if "requirepeer" in text:
        return "another user's server answers there; stop it, or set MAPFOLD_HOME to another folder"
    log = embedded_log(url)
    if log is not None:
        return f"the embedded server went away; its log: {log}"
    if "password" in text or "authentication" in text or "pg_hba" in text:
        return "check user and password in the URL"
    if "does not exist" in text and "database" in text:
        return "create it with createdb, or name another in the URL"
    if "does not exist" in text and "role" in text:
        return "create it with createuser, or name another in the URL"
    return "start the server or check the URL, or leave --db away for the embedded server"


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    told = next((line for line in lines if "FATAL" in line), lines[0] if lines else repr(error))
    return told.rstrip(".;")


def _without_values(text: str, url: str) -> str:
    """``text`` without what libpq quotes of the URL's other parts: ``invalid sslmode: "…"``."""
    said = conninfo_to_dict(url)
    public = {said.get(name) for name in _PUBLIC}
    for value in set(said.values()) - public:
        text = text.replace(f'"{value}"', '"…"')
    return text
