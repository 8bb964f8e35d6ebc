"""Waiting until nobody can still be looking at what a swap replaced.

A reader may have looked a name up just before the swap and not have locked anything yet. Such a
reader's transaction began before the swap was committed, so it is enough to wait for all
transactions of this database that are older than now, as CREATE INDEX CONCURRENTLY does.
"""

import time
from typing import Final

from projections.postgres.connect import Connection

WAIT_SECONDS: Final = 10.0
POLL_SECONDS: Final = 0.01
_EARLIER: Final = """
SELECT count(*) FROM pg_stat_activity
WHERE datname = current_database() AND pid <> pg_backend_pid()
  AND xact_start IS NOT NULL AND xact_start <= %s AND backend_type = 'client backend'
"""


def earlier_transactions_ended(connection: Connection) -> bool:
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
