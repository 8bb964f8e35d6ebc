"""One PostgreSQL data folder: make it, start a server on it, stop it. Knows nothing of sharing.

The server is a projection's store, not the truth, and it is for one machine's owner:

* It listens on a unix socket only. The socket stands in the data folder, which is 0700, so the
  folder's permissions are the authentication (``trust`` means: whoever may open the socket). For a
  path too long for a socket (107 bytes) see `_socket_folder`. A data folder that belongs to another
  user, or that others may write, is refused.
* A new data folder is made beside its place and renamed, so a killed ``initdb`` leaves no half one.
* PostgreSQL refuses to run as root; `_system_user` says as whom it runs then.
"""

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from projections.errors import EmbeddedServerError

from . import server_user as _socket_folder
from .server_user import (
    give_to_server_user,
    let_server_user_enter,
    server_identity,
    server_uid,
    server_user,
)

SUPERUSER: Final = "postgres"
START_SECONDS: Final = 60
MAX_SOCKET_PATH: Final = 107 if os.uname().sysname == "Linux" else 103
SOCKET_NAME: Final = ".s.PGSQL.5432"
LOG_NAME: Final = "server.log"
PROBE_SECONDS: Final = 2.0

SETTINGS: Final[Mapping[str, str]] = {
    "listen_addresses": "",
    # The rows can be made again from the log, so WAL need only bring a crashed server back to a
    # consistent state: `minimal` lets COPY into a table of the same transaction skip it.
    "wal_level": "minimal",
    "max_wal_senders": "0",
    # A commit need not wait for the disk: rows and checkpoint are lost *together*, and tail goes on
    # from whichever checkpoint it finds. fsync stays on: a torn projection would be a silent lie.
    "synchronous_commit": "off",
    # A rebuild writes everything once; without room it would checkpoint all the way through.
    "max_wal_size": "4GB",
    "checkpoint_timeout": "30min",
    # Mapped, not touched until used: costs a small map nothing, keeps 300k vectors in memory.
    "shared_buffers": "512MB",
    "work_mem": "32MB",
    # Queries take milliseconds; compiling them takes longer than running them.
    "jit": "off",
    # Pages come from memory on such a machine: an index read costs about what a scan read does.
    "random_page_cost": "1.1",
    "max_connections": "64",
    "log_checkpoints": "off",
    "timezone": "UTC",
    "log_timezone": "UTC",
}


@dataclass(frozen=True, slots=True)
class Cluster:
    """A data folder and the programs that serve it. Call `create` before `start`."""

    data: Path
    programs: Path

    def create(self) -> None:
        """Make the data folder if there is none."""
        if (self.data / "PG_VERSION").exists():
            return
        fresh = self.data.with_name(self.data.name + ".new")
        with _as_one_line("make a data folder", self.data):
            shutil.rmtree(fresh, ignore_errors=True)
            fresh.mkdir(parents=True, mode=0o700)
            give_to_server_user(fresh)
            let_server_user_enter(fresh, self.programs)
            self._run(
                "initdb", "--pgdata", str(fresh), "--username", SUPERUSER, "--auth", "trust",
                "--encoding", "UTF8", "--locale-provider", "builtin", "--builtin-locale", "C.UTF-8",
                "--locale", "C", "--no-instructions", "--no-sync",
            )  # fmt: skip
            fresh.rename(self.data)

    def running(self) -> bool:
        """True when a server serves this folder: it takes a connection on its socket.

        Not asked of the process table: where process 1 does not reap, as in many containers, a
        killed server stays there for ever.
        """
        self._refuse_others()
        folder = self.socket_dir()
        if folder is None:
            return False
        with socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(PROBE_SECONDS)
            try:
                probe.connect(str(folder / SOCKET_NAME))
            except (FileNotFoundError, ConnectionRefusedError):
                return False
            except (TimeoutError, BlockingIOError):  # there, and busy
                return True
            return True

    def start(self) -> None:
        """Start the server and wait until it takes connections."""
        self._refuse_others()
        with _as_one_line("start", self.data):
            folder = self.data if self._holds_socket() else _socket_folder.find_or_make(self.data)
        options = " ".join(
            f"-c {name}={_quoted(value)}"
            for name, value in {**SETTINGS, "unix_socket_directories": str(folder)}.items()
        )
        with contextlib.suppress(FileNotFoundError):
            (self.data / LOG_NAME).replace(self.data / f"{LOG_NAME}.1")
        with _as_one_line("start", self.data):
            let_server_user_enter(self.data, self.programs)
            _forget_dead_server(self.data / "postmaster.pid", folder / f"{SOCKET_NAME}.lock")
            self._run(
                "pg_ctl", "start", "--wait", "--timeout", str(START_SECONDS), "--silent",
                "--pgdata", str(self.data), "--log", str(self.data / LOG_NAME),
                "--options", options,
            )  # fmt: skip

    def stop(self) -> None:
        """Stop the server, ending its sessions; it writes everything down first."""
        with _as_one_line("stop", self.data):
            # Somebody may have closed a folder above since the start; pg_ctl must still get in.
            let_server_user_enter(self.data, self.programs)
            self._run(
                "pg_ctl", "stop", "--wait", "--timeout", str(START_SECONDS), "--mode", "fast",
                "--silent", "--pgdata", str(self.data),
            )  # fmt: skip

    def socket_dir(self) -> Path | None:
        """Where the server's socket stands; None when that is chosen at its next start."""
        if self._holds_socket():
            return self.data
        return _socket_folder.find(self.data)

    def _holds_socket(self) -> bool:
        return len(os.fsencode(self.data / SOCKET_NAME)) <= MAX_SOCKET_PATH

    def _refuse_others(self) -> None:
        """Raise EmbeddedServerError when the data folder is not ours alone, as PostgreSQL would."""
        try:
            status = self.data.stat()
        except FileNotFoundError:
            return
        if status.st_uid != server_uid() or status.st_mode & 0o027:
            raise EmbeddedServerError(
                f"{self.data}: of user {status.st_uid}, mode {status.st_mode & 0o777:o}: only a"
                f" folder that {server_user()} alone can write is trusted; set MAPFOLD_HOME to"
                " another folder, or give a database of your own with --db"
            )

    def _run(self, program: str, *arguments: str) -> None:
        # Output goes to a file: the server inherits it, and a pipe would never see its end.
        with tempfile.TemporaryFile() as output:
            result = subprocess.run(  # noqa: S603 - our own programs, arguments as a list
                [self.programs / program, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                check=False,
                cwd="/",
                start_new_session=True,  # Ctrl-C is for us; the server is stopped by us
                **server_identity(),
            )
            output.seek(0)
            text = output.read().decode("utf-8", "replace")
        if result.returncode:
            raise subprocess.CalledProcessError(result.returncode, program, text)


def _forget_dead_server(*locks: Path) -> None:
    """Remove the lock files of a killed server that PostgreSQL would take for alive."""
    for lock in locks:
        # No such file, no such process, or no /proc on this system: nothing to forget.
        with contextlib.suppress(OSError, IndexError):
            pid = lock.read_text().split()[0]
            status = Path("/proc", pid, "stat").read_text()
            if status.rpartition(")")[2].split()[0] == "Z":
                lock.unlink()


@contextlib.contextmanager
def _as_one_line(what: str, data: Path) -> Iterator[None]:
    """Turn whatever goes wrong into one EmbeddedServerError that quotes the server's log."""
    advice = "or give a database of your own with --db"
    try:
        yield
    except subprocess.CalledProcessError as error:
        log = data / LOG_NAME
        said = _tail(log.read_text("utf-8", "replace")) if log.exists() else ""
        said = said or _tail(str(error.output))
        raise EmbeddedServerError(
            f"{data}: the embedded server did not {what}: {said} (log: {log}); mend it, {advice}"
        ) from None
    except OSError as error:
        raise EmbeddedServerError(
            f"{data}: the embedded server did not {what}: {error}; mend it, {advice}"
        ) from None


def _tail(text: str) -> str:
    """The last lines, joined into one; what comes before a FATAL line tells why."""
    return " / ".join([line.strip() for line in text.splitlines() if line.strip()][-3:])


def _quoted(value: str) -> str:
    """A value as pg_ctl's shell takes it."""
    return "'" + value.replace("'", "'\\''") + "'"
