"""Access to ``cypher()``: load AGE into a session, and keep readers from writing through it.

The clauses of ``cypher()`` that write do not run as SQL's UPDATE and DELETE do, and check less.
Tried with a role that has nothing but USAGE and SELECT:

==================================================  =========  ================
what the role does                                  AGE 1.5.0  AGE 1.7.0, 1.8.0
==================================================  =========  ================
``MATCH (n) SET``, ``REMOVE``, ``DELETE``           written    refused
the same on a vertex or an edge that the query      written    written
makes up: ``WITH {id: …, …}::vertex AS n SET …``
the same with row-level security on the tables      written    not written
==================================================  =========  ================

A read-only transaction and a revoked EXECUTE on ``cypher`` change nothing of this. AGE 1.6 has not
been tried and is taken to be like 1.5.

So each table of our graph gets row-level security policies that repeat its privileges: a role may
change rows through ``cypher()`` if and only if it may change them through SQL. The policies do not
apply to the owner. With an older AGE only a missing USAGE on ``ag_catalog`` helps; ``mapfold db
roles`` grants it to readers only where the policies are in force.
"""

import re
from typing import Final

import psycopg
from psycopg import sql

from eventsrc.base.text import advised
from projections.fold.map_errors import ExtensionMissing

from .connection import Connection, connect, describe_connection, extension_version, statements
from .labels import GRAPH, LABELS

FIRST_ENFORCING_VERSION: Final = (1, 7)
"""The first version of AGE that applies row-level security to what ``cypher()`` writes."""

PARENTS: Final = ("_ag_label_vertex", "_ag_label_edge")
"""The tables that AGE has all labels' tables inherit from."""


def connect_for_cypher(url: str, *, application: str = "mapfold ask") -> Connection:
    """An autocommit connection for Cypher: AGE loaded, ag_catalog on the search path."""
    connection = connect(url, application=application, autocommit=True)
    try:
        _load_age(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def _load_age(connection: Connection) -> None:
    """Set a session up for ``cypher()``. Raises ExtensionMissing.

    LOAD is for superusers only. Calling any of AGE's C functions loads its library too, and that an
    ordinary reader may do.
    """
    try:
        connection.execute("SELECT ag_catalog.agtype_build_map()")
    except (psycopg.errors.InvalidSchemaName, psycopg.errors.UndefinedFunction):
        raise ExtensionMissing(
            f"{describe_connection(connection)}: the extension age is not created there; run"
            f" `{advised('replay')}`, or have a superuser run CREATE EXTENSION age"
        ) from None
    except psycopg.errors.InsufficientPrivilege:
        raise ExtensionMissing(_age_forbidden(connection)) from None
    connection.execute('SET search_path = ag_catalog, "$user", public')


def refuse_without_age(connection: Connection) -> None:
    """Raise ExtensionMissing if this user may not use AGE's operators, which reads of the graph's
    tables by id need too; the server's own message would name an operator."""
    row = connection.execute(
        "SELECT has_schema_privilege(oid, 'USAGE') FROM pg_catalog.pg_namespace"
        " WHERE nspname = 'ag_catalog'"
    ).fetchone()
    if row is not None and not row[0]:
        raise ExtensionMissing(_age_forbidden(connection))


def _age_forbidden(connection: Connection) -> str:
    connection.rollback()
    user, version = connection.info.user, extension_version(connection, "age") or ""
    forbidden = f"{describe_connection(connection)}: user {user} may not use Apache AGE"
    if enforces_row_security(version):
        return f"{forbidden}; have a superuser run GRANT USAGE ON SCHEMA ag_catalog TO {user}"
    return (
        f"{forbidden} {version}, which would let it change the graph whatever its privileges; ask"
        " as the owner or as a member of mapfold_writer, or use AGE 1.7 or later"
    )


def enforces_row_security(version: str) -> bool:
    """Whether this version of AGE applies row-level security to what ``cypher()`` writes."""
    found = re.match(r"(\d+)\.(\d+)", version)
    return found is not None and (int(found[1]), int(found[2])) >= FIRST_ENFORCING_VERSION


def add_policies(connection: Connection, graph: str) -> None:
    """Put the policies on all tables of a graph, if this version of AGE enforces them."""
    if not enforces_row_security(extension_version(connection, "age") or ""):
        return
    for label in (*PARENTS, *LABELS):
        table = sql.Identifier(graph, label)
        name = sql.Literal(table.as_string(connection))
        connection.execute(statements("cypher")["add_policies"].format(table=table, name=name))


def policies_apply(connection: Connection) -> bool:
    """Whether the policies apply to this session, which is not the owner's: COPY is refused."""
    table = sql.Identifier(GRAPH, LABELS[0]).as_string(connection)
    row = connection.execute(statements("cypher")["policies_apply"], {"table": table}).fetchone()
    return row is not None and bool(row[0])


def unwanted_writers(connection: Connection) -> list[str]:
    """Roles that can change the graph through ``cypher()`` and by their privileges must not."""
    version = extension_version(connection, "age")
    if version is None:
        return []
    values = {"graph": GRAPH, "enforced": enforces_row_security(version)}
    rows = connection.execute(statements("cypher")["unwanted_writers"], values).fetchall()
    return [str(name) for (name,) in rows]
