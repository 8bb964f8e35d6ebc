"""Drop the tables that a swap has replaced, once their last readers have ended; and privileges:
those carried over to the tables of a rebuild, and the SQL of the roles for readers and writers.

The swap itself is ``swap_in`` of the shadows of `graph_sink` and `vector_sink`.

A reader may have resolved a name just before the swap without holding a lock yet. Its transaction
began before the swap was committed, so it is enough to wait for all transactions of this database
that are older than now, as CREATE INDEX CONCURRENTLY does.

Dropping a large map may take longer than the swap, as its pages go back to the file system. So the
DROP is sent and the connection closed without waiting; the session ends when the DROP is done. One
that is cut short, for example by a stop of the server, is rolled back, and the next rebuild drops.

A session that drops holds the drop lock. A rebuild does not touch the old names while another
session holds it, and waits for it before its own swap.
"""

import time
from collections.abc import Collection
from typing import Final

from psycopg import sql

from .connection import Connection, statements
from .cypher import FIRST_ENFORCING_VERSION
from .labels import SINKS, SinkName

WAIT_SECONDS: Final = 10.0
POLL_SECONDS: Final = 0.01
_EARLIER_TRANSACTIONS: Final = """
SELECT count(*) FROM pg_stat_activity
WHERE datname = current_database() AND pid <> pg_backend_pid()
  AND xact_start IS NOT NULL AND xact_start <= %s AND backend_type = 'client backend'
"""


def wait_for_earlier_transactions(connection: Connection) -> bool:
    """True once all transactions older than now have ended; False after ``WAIT_SECONDS``.

    An ordinary role does not see when other users' transactions began, and does not wait for them;
    DROP still waits for their locks.
    """
    row = connection.execute("SELECT clock_timestamp()").fetchone()
    now = row[0] if row else None
    deadline = time.monotonic() + WAIT_SECONDS
    while True:
        waiting = connection.execute(_EARLIER_TRANSACTIONS, [now]).fetchone()
        if waiting is None or waiting[0] == 0:
            return True
        if time.monotonic() > deadline:
            return False
        time.sleep(POLL_SECONDS)


def try_drop_lock(connection: Connection, sink: SinkName) -> bool:
    """Take the drop lock until the session ends; False while another session has it."""
    number = {"number": SINKS[sink].drop_lock}
    row = connection.execute(statements("checkpoint")["lock"], number).fetchone()
    return row is not None and bool(row[0])


def wait_for_drop(connection: Connection, sink: SinkName) -> None:
    """Wait for the drop lock and hold it until the transaction ends."""
    number = {"number": SINKS[sink].drop_lock}
    connection.execute(statements("checkpoint")["wait_for_lock"], number)


def send_and_close(connection: Connection, statement: sql.Composed) -> None:
    """Send ``statement`` to the server and close the connection without waiting for it."""
    connection.pgconn.send_query(statement.as_bytes(connection))
    connection.close()


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
