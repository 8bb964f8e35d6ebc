"""Database servers that a test may kill, and data folders that are copied, not initialised."""

import contextlib
import fcntl
import os
import select
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from projections.postgres.connection import connect, ensure_extension
from projections.postgres.embedded import EmbeddedServer
from tests.support.thorough import THOROUGH

WAIT_S = 120.0

CARELESS = {"fsync": "off", "full_page_writes": "off", "max_wal_size": "256MB"}
"""Settings of servers of tests, which kill servers and never the machine, and write little."""

MEMORY_DISK = Path("/dev/shm")
_ROOM_BYTES = 4 << 30


def _folder_of_servers() -> Path:
    """Where databases are made in a third of the time: in memory, where there is room for them."""
    if THOROUGH or not MEMORY_DISK.is_dir():
        return Path(tempfile.gettempdir())
    roomy = shutil.disk_usage(MEMORY_DISK).free >= _ROOM_BYTES
    return MEMORY_DISK if roomy else Path(tempfile.gettempdir())


# Not pytest's own temporary folder: each new session takes its permissions back to 0700, under the
# feet of a server that runs as another user. The workers of a run inherit the variable.
RUN_HOME = Path(
    os.environ.setdefault(
        "MAPFOLD_TEST_RUN", str(_folder_of_servers() / f"mapfold-test-{os.getpid()}")
    )
)
"""A folder of this test run's own, shared by its workers."""


def furnish(home: Path, *, extensions: bool = False) -> Path:
    """Give ``home`` the data folder that its first start would make; returns ``home``.

    It is a copy of one that is made once a run, because initdb takes ten times as long. With
    ``extensions`` it has age and vector. Its server does not wait for the disk. Under
    scripts/test_slow the first start makes it.
    """
    if not THOROUGH:
        made = _data_folder(extensions)
        home.mkdir(parents=True, exist_ok=True)
        subprocess.run(["cp", "-a", str(made), str(home / "pg")], check=True)
    return home


def _data_folder(extensions: bool) -> Path:
    """The data folder to copy; made by the first worker that needs it."""
    home = RUN_HOME / ("extended" if extensions else "plain")
    home.mkdir(parents=True, exist_ok=True)
    with (home / "made.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (home / "made").exists():
            with EmbeddedServer(home) as server:
                if extensions:
                    with connect(server.url, autocommit=True) as connection:
                        ensure_extension(connection, "age")
                        ensure_extension(connection, "vector")
            (home / "pg" / "server.log").unlink()
            with (home / "pg" / "postgresql.auto.conf").open("a") as settings:
                settings.writelines(f"{each} = {value}\n" for each, value in CARELESS.items())
                # A killed server leaves its memory behind: in the folder, and not for good.
                settings.write("dynamic_shared_memory_type = mmap\n")
            (home / "made").touch()
    return home / "pg"


@contextlib.contextmanager
def server_to_kill() -> Iterator[EmbeddedServer]:
    """A running server of its own, with both extensions, stopped and removed at the end."""
    RUN_HOME.mkdir(parents=True, exist_ok=True)
    home = Path(tempfile.mkdtemp(prefix="kill-", dir=RUN_HOME))
    furnish(home, extensions=True)
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
    """SIGKILL to the postmaster; returns when all of its processes have ended.

    Each notices by itself, some later than others, and serves its client until then. The postmaster
    is stopped first, so that it forks none that would be missed.
    """
    postmaster = int((server.data / "postmaster.pid").read_text().split()[0])
    with contextlib.ExitStack() as stack:
        waiting, sessions = select.poll(), set()
        os.kill(postmaster, signal.SIGSTOP)
        children = Path(f"/proc/{postmaster}/task/{postmaster}/children").read_text("ascii")
        for pid in map(int, children.split()):
            with contextlib.suppress(ProcessLookupError):  # it has ended already
                session = os.pidfd_open(pid)
                stack.callback(os.close, session)
                waiting.register(session, select.POLLIN)
                sessions.add(session)
        os.kill(postmaster, signal.SIGKILL)
        while sessions:
            ended = waiting.poll(WAIT_S * 1000)
            assert ended, "a session outlives its server"
            for session, _ in ended:
                waiting.unregister(session)
                sessions.remove(session)
