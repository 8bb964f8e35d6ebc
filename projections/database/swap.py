"""Waiting until nobody can still be looking at what a swap replaced.

A reader may have looked a name up just before the swap and not have locked anything yet. Such a
reader's transaction began before the swap was committed, so it is enough to wait for all
transactions of this database that are older than now, as CREATE INDEX CONCURRENTLY does.

Leaving it to the server to drop what a swap has replaced.

Dropping gives pages back to the file system, which for a large map may take longer than the swap,
and nobody needs to wait for it: the new map is served. So the statement is sent, and the session is
left alone with it; it ends when that is done. What is cut short (a server that is stopped, say) is
rolled back, and dropped by the next rebuild.

A session that drops holds a lock. The next rebuild leaves the names alone while somebody holds it,
and waits for it before its own swap needs them.
"""

import time
from typing import Final

from psycopg import sql

from .connection import Connection
from .sink import SinkName
from .statements import statements

WAIT_SECONDS: Final = 10.0
POLL_SECONDS: Final = 0.01
_EARLIER: Final = """
SELECT count(*) FROM pg_stat_activity
WHERE datname = current_database() AND pid <> pg_backend_pid()
  AND xact_start IS NOT NULL AND xact_start <= %s AND backend_type = 'client backend'
"""


def wait_for_earlier_transactions(connection: Connection) -> bool:
    """True once they have; False if some reader sits in one for longer than we care to wait.

    Sessions of other users show no start time to an ordinary role; they are then not waited for,
    and dropping waits for their locks as it always does.
    """
    row = connection.execute("SELECT clock_timestamp()").fetchone()
    now = row[0] if row else None
    deadline = time.monotonic() + WAIT_SECONDS
    while True:
        waiting = connection.execute(_EARLIER, [now]).fetchone()
        if waiting is None or waiting[0] == 0:
            return True
        if time.monotonic() > deadline:
            return False
        time.sleep(POLL_SECONDS)


_LOCK_NUMBERS: Final[dict[SinkName, int]] = {"graph": 17, "vectors": 18}


def try_drop_lock(connection: Connection, sink: SinkName) -> bool:
    """Take the lock until the session ends; False while another session drops."""
    number = {"number": _LOCK_NUMBERS[sink]}
    row = connection.execute(statements("checkpoint")["lock"], number).fetchone()
    return row is not None and bool(row[0])


def wait_for_drop(connection: Connection, sink: SinkName) -> None:
    """Wait until nobody drops any more. Holds the lock until the transaction ends."""
    number = {"number": _LOCK_NUMBERS[sink]}
    connection.execute(statements("checkpoint")["wait_for_lock"], number)


def send_and_close(connection: Connection, statement: sql.Composed) -> None:
    """Send ``statement`` to the server and close the connection without waiting for it."""
    connection.pgconn.send_query(statement.as_bytes(connection))
    connection.close()
