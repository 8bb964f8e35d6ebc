"""A PostgreSQL data folder: make it, start a server on it, stop the server.

* The server listens on a unix socket only. The socket is in the data folder, which is 0700, so the
  folder's permissions are the authentication (``trust`` means: all who may open the socket). Where
  the path is too long for a socket (107 bytes), the socket has a folder of its own. A data folder
  that belongs to another user, or that others may write, is refused.
* A new data folder is made under another name and renamed, so a killed ``initdb`` leaves no partial
  one.
* PostgreSQL refuses to run as root; `server_user` has the user that it runs as then.
"""

import contextlib
import errno
import os
import select
import shutil
import signal
import socket
import stat
import struct
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Final

from eventsrc.base.text import advised
from projections.fold.map_errors import EmbeddedServerError

from .server_user import (
    find_or_make_socket_folder,
    find_socket_folder,
    give_to_server_user,
    let_server_user_enter,
    server_identity,
    server_uid,
    server_user,
)

SUPERUSER: Final = "postgres"
START_SECONDS: Final = 60
STOP_SECONDS: Final = 300
"""A stop writes everything to disk first; on a busy disk that has taken more than a minute."""
MAX_SOCKET_PATH: Final = 107 if os.uname().sysname == "Linux" else 103
SOCKET_NAME: Final = ".s.PGSQL.5432"
LOG_NAME: Final = "server.log"
PROBE_SECONDS: Final = 2.0

SETTINGS: Final[Mapping[str, str]] = {
    "listen_addresses": "",
    # The rows can be rebuilt from the log, so WAL is only for crash recovery: with `minimal`, COPY
    # into a table made in the same transaction writes none.
    "wal_level": "minimal",
    "max_wal_senders": "0",
    # A commit need not wait for the disk: rows and checkpoint are lost *together*, and tail goes on
    # from the checkpoint that it finds. fsync stays on: nothing would notice torn pages.
    "synchronous_commit": "off",
    # A rebuild writes everything once; with the default it would checkpoint again and again.
    "max_wal_size": "4GB",
    "checkpoint_timeout": "30min",
    # Not allocated until used: costs a small map nothing, keeps 300k vectors in memory.
    "shared_buffers": "512MB",
    "work_mem": "32MB",
    # Queries take milliseconds; compiling them takes longer than running them.
    "jit": "off",
    # Pages come from memory: a random read costs about what a sequential one does.
    "random_page_cost": "1.1",
    "max_connections": "64",
    "log_checkpoints": "off",
    "timezone": "UTC",
    "log_timezone": "UTC",
}


_POINTERS_TO_LOG: Final = ("pg_ctl: could not start server", "Examine the log output.")


@dataclass(frozen=True, slots=True)
class Cluster:
    """A data folder and the programs that serve it. Call `create` before `start`."""

    data: Path
    programs: Path

    def create(self) -> None:
        """Make the data folder if it does not exist. Raises EmbeddedServerError for another."""
        with _server_errors("read", self.data):
            if (self.data / "PG_VERSION").exists():
                return
            if self.data.is_symlink() or (self.data.exists() and not _is_empty(self.data)):
                raise EmbeddedServerError(
                    f"{self.data}: there is no PG_VERSION in it, so it is damaged or no data folder"
                    f" of PostgreSQL; {reset_advice()}"
                )
        new = self.data.with_name(self.data.name + ".new")
        with _server_errors("make a data folder", self.data):
            if new.is_symlink() or new.is_file():
                new.unlink()
            shutil.rmtree(new, ignore_errors=True)
            new.mkdir(parents=True, mode=0o700)
            give_to_server_user(new)
            let_server_user_enter(new, self.programs)
            self._run(
                "initdb", "--pgdata", str(new), "--username", SUPERUSER, "--auth", "trust",
                "--encoding", "UTF8", "--locale-provider", "builtin", "--builtin-locale", "C.UTF-8",
                "--locale", "C", "--no-instructions", "--no-sync",
            )  # fmt: skip
            new.rename(self.data)

    def set_aside(self) -> Path | None:
        """Rename the data folder, damaged or not, after its server was stopped; its new name. None
        if there is none.

        Raises EmbeddedServerError.
        """
        if not os.path.lexists(self.data):
            return None
        with _server_errors("set aside", self.data):
            if self._trusted() and self.running():
                self._stop_listener()
            numbered = (self.data.with_name(f"{self.data.name}.aside-{n}") for n in count(1))
            aside = next(name for name in numbered if not os.path.lexists(name))
            self.data.rename(aside)
            return aside

    def _stop_listener(self) -> None:
        """Stop the server that listens on the socket, without a look at any of its files.

        SO_PEERCRED names the process that called listen(), which is the postmaster.
        """
        folder = self.socket_dir()
        if folder is None or not hasattr(socket, "SO_PEERCRED"):
            self.stop()
            return
        with socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(PROBE_SECONDS)
            probe.connect(str(folder / SOCKET_NAME))
            answer = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        process, user, _ = struct.unpack("3i", answer)
        if user != server_uid():
            raise EmbeddedServerError(f"{self.data}: user {user} listens on its socket; stop that")
        ended = os.pidfd_open(process)
        try:
            signal.pidfd_send_signal(ended, signal.SIGQUIT)
            if not select.select([ended], [], [], START_SECONDS)[0]:
                raise EmbeddedServerError(f"{self.data}: process {process} does not end; kill it")
        finally:
            os.close(ended)

    def _trusted(self) -> bool:
        status = self.data.lstat()
        return stat.S_ISDIR(status.st_mode) and status.st_uid == server_uid()

    def running(self) -> bool:
        """True when a server accepts a connection on this folder's socket.

        The process table is not used: where process 1 does not reap, as in many containers, a
        killed server stays in it forever.
        """
        self._refuse_untrusted()
        folder = self.socket_dir()
        if folder is None:
            return False
        with socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(PROBE_SECONDS)
            try:
                probe.connect(str(folder / SOCKET_NAME))
            except (FileNotFoundError, ConnectionRefusedError):
                return False
            except (TimeoutError, BlockingIOError):  # running, and busy
                return True
            return True

    def let_in(self) -> None:
        """Allow the server's user to enter the folders above data and programs. If that was revoked
        since the server started, a new session cannot load the extensions."""
        with _server_errors("open the folders of", self.data):
            let_server_user_enter(self.data, self.programs)

    def start(self) -> None:
        """Start the server and wait until it accepts connections."""
        self._refuse_untrusted()
        with _server_errors("start", self.data):
            folder = self.data if self._fits_socket() else find_or_make_socket_folder(self.data)
        options = " ".join(
            f"-c {name}={_shell_quoted(value)}"
            for name, value in {**SETTINGS, "unix_socket_directories": str(folder)}.items()
        )
        with contextlib.suppress(FileNotFoundError):
            (self.data / LOG_NAME).replace(self.data / f"{LOG_NAME}.1")
        with _server_errors("start", self.data):
            let_server_user_enter(self.data, self.programs)
            _remove_stale_locks(
                self.data, self.data / "postmaster.pid", folder / f"{SOCKET_NAME}.lock"
            )
            self._run(
                "pg_ctl", "start", "--wait", "--timeout", str(START_SECONDS), "--silent",
                "--pgdata", str(self.data), "--log", str(self.data / LOG_NAME),
                "--options", options,
            )  # fmt: skip

    def stop(self) -> None:
        """Stop the server after it has ended its sessions and written everything to disk."""
        with _server_errors("stop", self.data):
            # A folder above may have been closed since the start; pg_ctl must still get in.
            let_server_user_enter(self.data, self.programs)
            try:
                self._run(
                    "pg_ctl", "stop", "--wait", "--timeout", str(STOP_SECONDS), "--mode", "fast",
                    "--silent", "--pgdata", str(self.data),
                )  # fmt: skip
            except subprocess.CalledProcessError as error:
                if "does not shut down" not in str(error.output):
                    raise
                self._stop_listener()  # damaged data can keep it in recovery for ever

    def socket_dir(self) -> Path | None:
        """The folder of the server's socket; None when it will be chosen at the next start."""
        if self._fits_socket():
            return self.data
        return find_socket_folder(self.data)

    def _fits_socket(self) -> bool:
        return len(os.fsencode(self.data / SOCKET_NAME)) <= MAX_SOCKET_PATH

    def _refuse_untrusted(self) -> None:
        """Raise EmbeddedServerError when others own or may write the data folder."""
        try:
            status = self.data.stat()
        except FileNotFoundError:
            return
        if status.st_uid != server_uid() or status.st_mode & 0o027:
            raise EmbeddedServerError(
                f"{self.data}: of user {status.st_uid}, mode {status.st_mode & 0o777:o}: only a"
                f" folder that {server_user()} alone can write is trusted; set MAPFOLD_HOME to"
                f" another folder, or make this one again: {reset_advice()}"
            )

    def _run(self, program: str, *arguments: str) -> None:
        # Output goes to a file: the server inherits it, so a pipe would never reach its end.
        with tempfile.TemporaryFile() as output:
            result = subprocess.run(  # noqa: S603 - our own programs, arguments as a list
                [self.programs / program, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                check=False,
                cwd="/",
                start_new_session=True,  # Ctrl-C must not reach the server, which we stop
                **server_identity(),
            )
            output.seek(0)
            text = output.read().decode("utf-8", "replace")
        if result.returncode:
            raise subprocess.CalledProcessError(result.returncode, program, text)


def _remove_stale_locks(data: Path, *locks: Path) -> None:
    """Remove lock files whose process is a zombie, or no server of ``data``, which is a server's
    current folder: after a crash of the machine another process may have its number. PostgreSQL
    takes both for a server that is alive."""
    for lock in locks:
        # No such file, no such process, or no /proc on this system: nothing to remove.
        with contextlib.suppress(OSError, IndexError, ValueError):
            process = Path("/proc", str(int(lock.read_text().split()[0])))
            state = (process / "stat").read_text().rpartition(")")[2].split()[0]
            if state == "Z" or not (process / "cwd").samefile(data):
                lock.unlink()


@contextlib.contextmanager
def _server_errors(what: str, data: Path) -> Iterator[None]:
    """Turn failures into one EmbeddedServerError that quotes the program and the server's log."""
    try:
        yield
    except subprocess.CalledProcessError as error:
        log = data / LOG_NAME
        logged = log.read_text("utf-8", "replace") if log.exists() else ""
        reason = " / ".join([*_last_lines(str(error.output)), *_last_lines(logged)])
        raise EmbeddedServerError(
            f"{data}: the embedded server did not {what}: {reason} (log: {log});"
            f" {_advice(what, reason)}"
        ) from None
    except OSError as error:
        raise EmbeddedServerError(
            f"{data}: the embedded server did not {what}: {error}; {_advice(what, str(error))}"
        ) from None


def _advice(what: str, reason: str) -> str:
    if os.strerror(errno.ENOSPC) in reason:
        return "free space on that disk, or set MAPFOLD_HOME to a folder on another"
    if os.strerror(errno.EROFS) in reason:
        return "set MAPFOLD_HOME to a folder on a disk that can be written"
    if what in ("start", "read"):
        return reset_advice()
    return "fix it, or give a database of your own with --db"


def reset_advice() -> str:
    """What to do about damaged data."""
    return (
        f"all in it comes from logs: run `{advised('db', 'reset')}`, which sets it aside and makes"
        f" a new one, then `{advised('replay')}`; or give a database of your own with --db"
    )


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and not any(folder.iterdir())


def _last_lines(text: str) -> list[str]:
    """The last three lines that say something; the reason stands before the FATAL line."""
    lines = [line.strip() for line in text.splitlines()]
    return [line for line in lines if line and line not in _POINTERS_TO_LOG][-3:]


def _shell_quoted(value: str) -> str:
    """A value quoted for the shell that pg_ctl starts."""
    return "'" + value.replace("'", "'\\''") + "'"
