"""Keeping readers out for the moment of the swap, without ever making one fail.

Readers name the graph and AGE resolves each label's table by that name, so a reader in the middle
of a statement must not find half of its tables before the swap and half after. Therefore everything
that is replaced, graph and table, is locked exclusively *before* any name moves: a reader that
already has one of the tables is waited for; one that comes later waits at its first table, and
PostgreSQL resolves the name again when it gets the lock.

While we wait with some of the locks in hand, a reader may wait for us: a deadlock. So we wait only
briefly, let go of all of them, and try again; below the server's deadlock_timeout (1 s) it is
always us who give way. That goes for the locks of two databases together: no server sees a deadlock
between them, and the readers of one are not to wait until those of the other have ended.
"""

import contextlib
import time
from collections.abc import Sequence
from typing import Final

import psycopg

from projections.errors import DatabaseError
from projections.postgres.connect import database_errors

from ._stores import Store

ATTEMPT: Final = "SET LOCAL lock_timeout = '200ms'; SET LOCAL statement_timeout = '400ms'"
"""A sink's tables are locked by one statement, which may wait for one reader after the other: both
sinks together stay below a second."""
DONE: Final = "SET LOCAL lock_timeout = 0; SET LOCAL statement_timeout = 0"
PAUSE_S: Final = 0.02
PATIENCE_S: Final = 120.0


def lock_readers_out(stores: Sequence[Store]) -> None:
    """Lock what the stores' sinks will swap. Raises DatabaseError when readers never let go."""
    deadline = time.monotonic() + PATIENCE_S
    while (read := _still_read(stores)) is not None:
        if time.monotonic() > deadline:
            raise DatabaseError(
                f"{read.place}: readers kept the map locked for {PATIENCE_S:.0f} s; end their"
                " transactions, then run the rebuild again"
            )
        time.sleep(PAUSE_S)
    for store in stores:
        store.connection.execute(DONE)


class _StillRead(Exception):
    """A reader has one of the tables."""

    def __init__(self, store: Store) -> None:
        self.store = store


def _still_read(stores: Sequence[Store]) -> Store | None:
    """Try once: None when all is locked, else whose readers are in the way; then nothing is."""
    try:
        with contextlib.ExitStack() as savepoints:  # going back to them lets go of the locks
            for store in stores:
                with database_errors(store.url):
                    savepoints.enter_context(store.connection.transaction())
                    _lock(store)
    except _StillRead as reader:
        return reader.store
    return None


def _lock(store: Store) -> None:
    try:
        store.connection.execute(ATTEMPT)
        for sink in store.sinks:
            sink.lock(store.connection)
    except (psycopg.errors.LockNotAvailable, psycopg.errors.QueryCanceled):
        raise _StillRead(store) from None
