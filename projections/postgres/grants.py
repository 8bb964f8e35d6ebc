"""Privileges: carried over to the tables of a rebuild; SQL of the roles for readers and writers."""

from collections.abc import Collection
from typing import Final

from psycopg import sql

from .connection import Connection, statements
from .cypher import FIRST_ENFORCING_VERSION
from .labels import SINKS

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


def copy_privileges(
    connection: Connection, old: str, new: str, *, table: str | None = None
) -> None:
    """Grant on schema ``new`` what is granted on ``old``, for all tables or only ``table``.

    With ``table`` the schemas' own privileges are left as they are.
    """
    if table is None:
        for role, privilege in connection.execute(_SCHEMA_GRANTS, [old]).fetchall():
            _grant(connection, privilege, sql.SQL("SCHEMA {}").format(sql.Identifier(new)), role)
    for name, role, privilege in connection.execute(_TABLE_GRANTS, [old, table, table]).fetchall():
        _grant(connection, privilege, sql.Identifier(new, name), role)


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
