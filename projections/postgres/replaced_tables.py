"""Drop the tables that a swap has replaced, once their last readers have ended.

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
from typing import Final

from psycopg import sql

from .connection import Connection, statements
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
