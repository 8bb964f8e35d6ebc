"""Connections to the databases: their URLs, session settings, extensions, errors in one line.

The graph and the vectors share one database (the default) or have one each. Their URLs come from
``--db`` and ``--vector-db``, else MAPFOLD_DB and MAPFOLD_VECTOR_DB, else the embedded server. The
vectors go into the graph's database unless an option says otherwise.

Messages show host, port and database, never a password, and no part of a URL that cannot be parsed.

SQL statements are in ``sql/*.sql``. A file holds several, each under a line ``-- name: …``.
``{braces}`` are identifiers that `psycopg.sql` quotes, ``%(name)s`` are bind parameters; no value
gets in otherwise.
"""

import contextlib
import json
import logging
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Final, LiteralString, cast
from urllib.parse import unquote

import psycopg
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict, make_conninfo
from psycopg.rows import TupleRow

from eventsrc.base.errors import MisuseError
from projections.fold.map_errors import DatabaseError, DatabaseUnavailable, ExtensionMissing

from .data_folder import SUPERUSER, reset_advice
from .embedded import EmbeddedServer, embedded_log
from .labels import GRAPH, LABELS, SinkName

Connection = psycopg.Connection[TupleRow]

# Errors are raised, and printed once, by the command. Without a handler Python would also print
# what psycopg and its pool log about them.
logging.getLogger("psycopg").addHandler(logging.NullHandler())

CONNECT_SECONDS: Final = 10
_KEEPALIVES: Final[Mapping[str, int]] = {
    "keepalives_idle": 20,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    "tcp_user_timeout": 50_000,
}
"""A server that vanishes (power, network) is noticed within a minute, by default only after hours.
Values in the URL win."""
_SESSION_SETTINGS: Final[Mapping[str, str]] = {
    "statement_timeout": "0",
    "lock_timeout": "0",
    "idle_in_transaction_session_timeout": "0",
    "transaction_timeout": "0",  # from PostgreSQL 17 on
    "idle_session_timeout": "0",
    # Output formats, which a server's owner may have changed.
    "DateStyle": "ISO",
    "extra_float_digits": "1",
    "array_nulls": "on",
    # The server notices a writer that vanished, and releases its lock.
    "tcp_keepalives_idle": "20",
    "tcp_keepalives_interval": "10",
    "tcp_keepalives_count": "3",
}
_SHOWN_PARTS: Final = ("host", "port", "dbname", "user")
"""Parts of a URL that messages may show."""
_SECRETS: Final = frozenset(
    {"password", "sslpassword", "scram_client_key", "scram_server_key", "oauth_client_secret"}
)
_PRODUCTS: Final[Mapping[str, str]] = {"age": "Apache AGE", "vector": "pgvector"}


@dataclass(frozen=True, slots=True)
class Targets:
    """The databases of one projection. ``embedded`` is the embedded server, if it is used."""

    graph_url: str = field(repr=False)
    vector_url: str = field(repr=False)
    embedded: EmbeddedServer | None = None

    @property
    def one_database(self) -> bool:
        """True when graph and vectors are in one database and so in one transaction."""
        return self.graph_url == self.vector_url

    @property
    def urls(self) -> tuple[str, ...]:
        """Each database once."""
        return tuple(dict.fromkeys((self.graph_url, self.vector_url)))

    def url_of(self, sink: SinkName) -> str:
        """The database of a sink."""
        return self.graph_url if sink == "graph" else self.vector_url

    def restart_embedded(self) -> None:
        """Start the embedded server again, if it is used and has died."""
        if self.embedded is not None:
            self.embedded.start()


@contextlib.contextmanager
def open_targets(db: str | None = None, vector_db: str | None = None) -> Iterator[Targets]:
    """The databases to use. The embedded server, if needed, runs while the context is open."""
    graph_url = _url_from(db, "--db", "MAPFOLD_DB")
    vector_url = _url_from(vector_db, "--vector-db", "MAPFOLD_VECTOR_DB") or graph_url
    if graph_url is not None and vector_url is not None:
        yield Targets(graph_url, vector_url)
        return
    with EmbeddedServer() as server:
        yield Targets(graph_url or server.url, vector_url or server.url, server)


def _url_from(option: str | None, name: str, variable: str) -> str | None:
    """The URL of an option, else of an environment variable, checked; None when neither is set."""
    url, given_as = (option, name) if option else (os.environ.get(variable), variable)
    if not url:
        return None
    check_url(url, given_as)
    return url


def check_url(url: str, given_as: str = "the database's URL") -> None:
    """Raise MisuseError for what is no PostgreSQL URL, before anything connects.

    Neither the URL nor libpq's message, which quotes parts of it, is shown: any part may be a
    password. libpq itself reads ``//u:pa/ss@host`` as host ``u`` and port ``pa``.
    """
    if not _is_unambiguous(url):
        raise MisuseError(
            f"{given_as}: not a PostgreSQL URL (not shown, it may hold a password); write it as"
            " postgresql://user:password@host:port/database, with %40 for @, %2F for / and %25 for"
            " % in user and password"
        )


def _is_unambiguous(url: str) -> bool:
    """Whether libpq can parse a URL, and parses it as a person would."""
    try:
        parts = conninfo_to_dict(url)
    except (psycopg.Error, ValueError):  # ValueError: characters that have no UTF-8
        return False
    authority, _, path = url.partition("?")[0].partition("://")[2].partition("/")
    ports = [port for port in str(parts.get("port") or "").split(",") if port]
    return (
        url.startswith(("postgresql://", "postgres://"))
        and "\0" not in url  # libpq would end there
        and all(str(parts.get(name) or "").isprintable() for name in _SHOWN_PARTS)
        and authority.count("@") <= 1
        and "@" not in path
        and all(re.fullmatch("[0-9]{1,5}", port) and 0 < int(port) < 65536 for port in ports)
    )


def connect(url: str, *, application: str = "mapfold", autocommit: bool = False) -> Connection:
    """Open a connection. Raises DatabaseUnavailable with what to do next."""
    check_url(url)
    parts = conninfo_to_dict(url)
    missing = {name: value for name, value in _KEEPALIVES.items() if name not in parts}
    try:
        return psycopg.connect(
            # COPY data is encoded here, in UTF-8, whatever the server's default.
            make_conninfo(url, **missing, client_encoding="UTF8"),
            autocommit=autocommit,
            application_name=application,
            connect_timeout=CONNECT_SECONDS,
        )
    except psycopg.Error as error:  # also for a bad value in the URL, which libpq finds only now
        message = f"{_without_values(_first_line(error), url)}; {_advice(error, url)}"
        raise DatabaseUnavailable(f"{describe_target(url)}: {message}") from None


def pin_session_settings(connection: Connection) -> None:
    """Disable timeouts and pin the output formats, whatever the server's defaults.

    A rebuild folds for minutes between two statements, an index of many vectors takes longer, and a
    tail may be idle all night. TCP keepalives end the session when its client has died.
    """
    connection.execute(
        "SELECT set_config(name, wanted ->> name, false)"
        " FROM pg_catalog.pg_settings, (SELECT %s::jsonb) AS w(wanted) WHERE wanted ? name",
        [json.dumps(_SESSION_SETTINGS)],
    )


def ensure_extension(connection: Connection, name: LiteralString) -> str:
    """Create the extension ``age`` or ``vector`` if it is missing; returns its version."""
    version = extension_version(connection, name)
    if version is not None:
        return version
    where = describe_connection(connection)
    try:
        with connection.transaction():
            # Graph writers have ag_catalog first on the search path; created there, pgvector's
            # operators would not be found by others. AGE itself fixes its own schema.
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
        raise ExtensionMissing(_not_installed(name, where)) from None
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
    """Database, host and port of a URL or connection string, for messages; never a password."""
    try:
        parts = conninfo_to_dict(url)
    except psycopg.ProgrammingError:
        return "a database whose URL cannot be read"
    host = parts.get("host") or "local socket"
    port = parts.get("port") or 5432
    return f"database {parts.get('dbname') or parts.get('user') or 'default'} at {host}:{port}"


def describe_connection(connection: Connection) -> str:
    """`describe_target` of an open connection."""
    return describe_target(connection.info.dsn)


def url_without_secrets(url: str) -> str:
    """A URL of `check_url`, or the empty one of the embedded server, without its password and
    others that libpq takes as parameters, for command lines that are advised; libpq then reads the
    password from ~/.pgpass or PGPASSWORD."""
    if not url:
        return url
    scheme, _, rest = url.partition("://")
    rest, question, query = rest.partition("?")
    authority, slash, path = rest.partition("/")
    user, at, host = authority.rpartition("@")
    kept = [each for each in query.split("&") if unquote(each.partition("=")[0]) not in _SECRETS]
    shown = f"{scheme}://{user.partition(':')[0]}{at}{host}{slash}{path}"
    return f"{shown}?{'&'.join(kept)}" if question and kept else shown


@contextlib.contextmanager
def database_errors(url: str) -> Iterator[None]:
    """Turn psycopg's errors into ours: one line with the database and the server's message."""
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


def _not_installed(name: str, where: str) -> str:
    return (
        f"{where}: the server has no {_PRODUCTS.get(name, name)}; install the extension {name} on"
        " it, or use docker/compose.yaml, or omit --db for the embedded server"
    )


def _advice(error: psycopg.Error, url: str) -> str:
    text = str(error)
    if "requirepeer" in text:
        return "another user's server answers there; stop it, or set MAPFOLD_HOME to another folder"
    if "too many" in text or "connection slots" in text:
        return "end other commands, run fewer at once, or raise the server's max_connections"
    log = embedded_log(url)
    if isinstance(error, psycopg.errors.UndefinedFile):  # an OperationalError too
        return (
            "the server no longer finds that file: was the extension removed, or a folder above it"
            " closed to the server's user?" + (f" Its log: {log}" if log is not None else "")
        )
    if "password" in text or "authentication" in text or "pg_hba" in text:
        return "check user and password in the URL"
    damaged = ("could not open", "could not read", f'"{SUPERUSER}" does not exist')
    if log is not None and any(words in text for words in damaged):
        return f"its data is damaged (log: {log}); {reset_advice()}"
    if "does not exist" in text and "database" in text:
        return "create it with createdb, or name another in the URL"
    if "does not exist" in text and "role" in text:
        return "create it with createuser, or name another in the URL"
    if log is not None:
        return f"the embedded server went away; its log: {log}"
    return "start the server or check the URL, or omit --db for the embedded server"


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    first = next((line for line in lines if "FATAL" in line), lines[0] if lines else repr(error))
    return first.rstrip(".;")


def _without_values(text: str, url: str) -> str:
    """``text`` without the values that libpq quotes from the URL: ``invalid sslmode: "…"``."""
    parts = conninfo_to_dict(url)
    public = {parts.get(name) for name in _SHOWN_PARTS}
    for value in set(parts.values()) - public:
        text = text.replace(f'"{value}"', '"…"')
    return text


_NAME = re.compile(r"^-- name: (\w+)$", re.MULTILINE)


@cache
def statements(file: str) -> dict[str, sql.SQL]:
    """The statements of ``sql/<file>.sql`` by name."""
    text = files("projections.postgres").joinpath("sql", f"{file}.sql").read_text("utf-8")
    parts = _NAME.split(text)[1:]
    # The files are part of the program, so their text is as literal as a string here.
    bodies = {
        name: cast("LiteralString", body.strip())
        for name, body in zip(parts[::2], parts[1::2], strict=True)
    }
    return {name: sql.SQL(body) for name, body in bodies.items()}


@cache
def tables() -> dict[str, sql.Identifier]:
    """Identifiers of the label tables by label in lower case, for the ``{braces}``."""
    return {label.lower(): sql.Identifier(GRAPH, label) for label in LABELS}
