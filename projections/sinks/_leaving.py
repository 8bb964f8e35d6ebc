"""Leaving it to the server to drop what a swap has replaced.

Dropping gives pages back to the file system, which for a large map may take longer than the swap,
and nobody needs to wait for it: the new map is served. So the statement is sent, and the session is
left alone with it; it ends when that is done. What is cut short (a server that is stopped, say) is
rolled back, and dropped by the next rebuild.

A session that drops holds a lock. The next rebuild leaves the names alone while somebody holds it,
and waits for it before its own swap needs them.
"""

from typing import Final

from psycopg import sql

from projections.postgres.connect import Connection
from projections.sink import SinkName

from ._sql import statements

_LOCK_NUMBERS: Final[dict[SinkName, int]] = {"graph": 17, "vectors": 18}


def may_drop(connection: Connection, sink: SinkName) -> bool:
    """Take the lock until the session ends; False while another session drops."""
    number = {"number": _LOCK_NUMBERS[sink]}
    row = connection.execute(statements("checkpoint")["lock"], number).fetchone()
    return row is not None and bool(row[0])


def wait_for_drop(connection: Connection, sink: SinkName) -> None:
    """Wait until nobody drops any more. Holds the lock until the transaction ends."""
    number = {"number": _LOCK_NUMBERS[sink]}
    connection.execute(statements("checkpoint")["wait_for_lock"], number)


def leave_with(connection: Connection, statement: sql.Composed) -> None:
    """Send ``statement`` to the server and close the connection without waiting for it."""
    connection.pgconn.send_query(statement.as_bytes(connection))
    connection.close()
