"""Database servers that a test may kill."""

import contextlib
import os
import select
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psycopg

from projections.database.connection import connect, ensure_extension
from projections.database.embedded import EmbeddedServer

WAIT_S = 120.0


@contextlib.contextmanager
def server_to_kill() -> Iterator[EmbeddedServer]:
    """A running server of its own, with both extensions, stopped and removed at the end."""
    home = Path(tempfile.mkdtemp(prefix="mapfold-test-kill-"))
    server = EmbeddedServer(home)
    try:
        with server, connect(server.url, autocommit=True) as connection:
            ensure_extension(connection, "age")
            ensure_extension(connection, "vector")
            connection.close()
            yield server
    finally:
        server.stop()
        shutil.rmtree(home, ignore_errors=True)


def kill_postgres(server: EmbeddedServer) -> None:
    """SIGKILL to the postmaster; returns when all of its sessions have ended.

    Each notices by itself, some later than others, and serves its client until then.
    """
    with psycopg.connect(server.url, autocommit=True) as witness, contextlib.ExitStack() as stack:
        sessions = []
        for (pid,) in witness.execute("SELECT pid FROM pg_stat_activity").fetchall():
            sessions.append(os.pidfd_open(pid))
            stack.callback(os.close, sessions[-1])
        os.kill(int((server.data / "postmaster.pid").read_text().split()[0]), signal.SIGKILL)
        while sessions:
            ended, _, _ = select.select(sessions, [], [], WAIT_S)
            assert ended, "a session outlives its server"
            sessions = [session for session in sessions if session not in ended]
