"""Keeping readers out for the moment of the swap, without ever making one fail.

Readers name the graph and AGE resolves each label's table by that name, so a reader in the middle
of a statement must not find half of its tables before the swap and half after. Therefore everything
that is replaced, graph and table, is locked exclusively *before* any name moves: a reader that
already has one of the tables is waited for; one that comes later waits at its first table, and
PostgreSQL resolves the name again when it gets the lock.

While we wait with some of the locks in hand, a reader may wait for us: a deadlock. So we wait only
briefly, let go of all of them, and try again; below the server's deadlock_timeout (1 s) it is
always us who give way.
"""

import time
from typing import Final

import psycopg

from projections.errors import DatabaseError

from ._stores import Store

ATTEMPT: Final = "SET LOCAL lock_timeout = '200ms'"
PAUSE_S: Final = 0.02
PATIENCE_S: Final = 120.0


def lock_readers_out(store: Store) -> None:
    """Lock what the store's sinks will swap. Raises DatabaseError when readers never let go."""
    connection = store.connection
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            with connection.transaction():  # a savepoint: going back lets go of the locks
                connection.execute(ATTEMPT)
                for sink in store.sinks:
                    sink.lock(connection)
        except psycopg.errors.LockNotAvailable:
            if time.monotonic() > deadline:
                raise DatabaseError(
                    f"{store.place}: readers kept the map locked for {PATIENCE_S:.0f} s; end their"
                    " transactions, then run the rebuild again"
                ) from None
            time.sleep(PAUSE_S)
        else:
            connection.execute("SET LOCAL lock_timeout = DEFAULT")
            return
