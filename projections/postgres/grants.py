"""Privileges: carried over to the tables of a rebuild; SQL of the roles for readers and writers."""

from collections.abc import Collection
from typing import Final

from psycopg import sql

from .connection import Connection, statements
from .cypher import FIRST_ENFORCING_VERSION
from .labels import SINKS, Label

_PRIVILEGES: Final = {
    "SELECT": sql.SQL("SELECT"),
    "INSERT": sql.SQL("INSERT"),
    "UPDATE": sql.SQL("UPDATE"),
    "DELETE": sql.SQL("DELETE"),
    "USAGE": sql.SQL("USAGE"),
}
"""The privileges that are carried over: those that readers and writers of rows need."""
_SCHEMA_GRANTS: Final = """
SELECT coalesce(r.rolname, ''), a.privilege_type
FROM pg_namespace n CROSS JOIN aclexplode(n.nspacl) a LEFT JOIN pg_roles r ON r.oid = a.grantee
WHERE n.nspname = %s AND a.grantee <> n.nspowner
"""
_TABLE_GRANTS: Final = """
SELECT c.relname, coalesce(r.rolname, ''), a.privilege_type
FROM pg_class c CROSS JOIN aclexplode(c.relacl) a LEFT JOIN pg_roles r ON r.oid = a.grantee
WHERE c.relnamespace = (SELECT oid FROM pg_namespace WHERE nspname = %s)
  AND a.grantee <> c.relowner AND c.relkind = 'r' AND (%s::text IS NULL OR c.relname = %s)
"""
_TABLES: Final = """
SELECT relname FROM pg_class
WHERE relnamespace = (SELECT oid FROM pg_namespace WHERE nspname = %s) AND relkind = 'r'
"""
_LIKE: Final[dict[str, tuple[Label, ...]]] = {
    "Place": ("Floor", "Building"),
    "ADJACENT_TO": ("PART_OF",),
}
"""Labels that graphs of older versions do not have, by the label whose grants they get then."""


def copy_privileges(
    connection: Connection, old: str, new: str, *, table: str | None = None
) -> None:
    """Grant on schema ``new`` what is granted on ``old``, for all tables or only ``table``.

    With ``table`` the schemas' own privileges are left as they are.
    """
    if table is None:
        for role, privilege in connection.execute(_SCHEMA_GRANTS, [old]).fetchall():
            _grant(connection, privilege, sql.SQL("SCHEMA {}").format(sql.Identifier(new)), role)
    there = {name for (name,) in connection.execute(_TABLES, [old]).fetchall()}
    for name, role, privilege in connection.execute(_TABLE_GRANTS, [old, table, table]).fetchall():
        younger = [] if table else [label for label in _LIKE.get(name, ()) if label not in there]
        for each in (name, *younger):
            _grant(connection, privilege, sql.Identifier(new, each), role)


def copy_table_privileges(connection: Connection, schema: str, old: str, new: str) -> None:
    """Grant on table ``new`` of a schema what is granted on ``old``."""
    rows = connection.execute(_TABLE_GRANTS, [schema, old, old]).fetchall()
    for _, role, privilege in rows:
        _grant(connection, privilege, sql.Identifier(schema, new), role)


def _grant(connection: Connection, privilege: str, what: sql.Composable, role: str) -> None:
    if privilege in _PRIVILEGES:
        # The catalogue has no name for PUBLIC.
        who = sql.Identifier(role) if role else sql.SQL("PUBLIC")
        connection.execute(
            sql.SQL("GRANT {} ON {} TO {}").format(_PRIVILEGES[privilege], what, who)
        )


def roles_sql(sinks: Collection[str] = tuple(SINKS)) -> str:
    """SQL for psql that makes the roles of a database that holds ``sinks``."""
    parts = statements("roles")
    wanted = ["reader", "writer", *(name for name in SINKS if name in sinks)]
    first = sql.Literal(list(FIRST_ENFORCING_VERSION))
    return "\n\n".join(parts[name].format(first=first).as_string() for name in wanted) + "\n"
