"""Database servers that a test may kill, and data folders that are copied, not initialised.

PostgreSQL 17, AGE 1.5 and pgvector 0.8.0: Debian 13's packages, in a folder of their own.

apt fetches them from Debian's mirror, checked by the keys of this machine. The folder is kept (in
``$XDG_CACHE_HOME``, else ``~/.cache``); it is the root folder of the server, as its libraries are
newer than those of older systems. The server's data is made for each use and removed after it.

The folders of killed test runs: their servers are stopped, and they are removed.
"""

import contextlib
import fcntl
import os
import pwd
import re
import select
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final
from urllib.parse import quote

import psycopg

from projections.fold.map_errors import EmbeddedServerError
from projections.postgres.connection import connect, ensure_extension
from projections.postgres.embedded import EmbeddedServer
from projections.postgres.server_user import server_identity, server_user
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


PACKAGES: Final = ("base-files", "dash", "postgresql-17-age", "postgresql-17-pgvector")
PROGRAMS: Final = "/usr/lib/postgresql/17/bin"
SOURCE: Final = (
    "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg]"
    " http://deb.debian.org/debian trixie main\n"
)
DEBIAN_WAIT_S: Final = 300


class NoDebianPackages(Exception):
    """The packages cannot be had here; the message says why."""


@contextlib.contextmanager
def debian_server() -> Iterator[str]:
    """A superuser's URL of a running server, one at a time on a machine.

    Raises NoDebianPackages.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    top = cache / "mapfold-tests" / "debian-13"
    top.mkdir(parents=True, exist_ok=True)
    with (top / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        root = top / "root"
        if not root.exists():
            _fill(root)
        for left in (root / "tmp").glob("pg-*"):  # by a killed run
            _stop(root, left)
        data = Path(tempfile.mkdtemp(prefix="pg-", dir=root / "tmp"))
        try:
            yield _start(root, data)
        finally:
            _stop(root, data)


def _fill(root: Path) -> None:
    """Make the root folder, under another name until it is whole."""
    made = root.with_name("root.new")
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir()
    for archive in _archives(root.parent / "apt"):
        _tool("dpkg-deb", "--extract", str(archive), str(made))
    with (made / "etc" / "passwd").open("w") as users:  # by which the server's user has a name
        users.write("".join(f"{u.pw_name}:x:{u.pw_uid}:{u.pw_gid}::/:\n" for u in pwd.getpwall()))
    for folder in ("tmp", "dev/shm"):
        (made / folder).mkdir(parents=True, exist_ok=True)
        (made / folder).chmod(0o1777)
    (made / "dev" / "null").touch()
    (made / "dev" / "null").chmod(0o666)
    made.rename(root)


def _archives(apt: Path) -> list[Path]:
    """The packages and what they need, fetched without a change to this system's own."""
    for folder in ("lists/partial", "archives/partial"):
        (apt / folder).mkdir(parents=True, exist_ok=True)
    (apt / "sources.list").write_text(SOURCE)
    (apt / "status").touch()
    settings = {
        "Dir::Etc::sourcelist": apt / "sources.list",
        "Dir::Etc::sourceparts": "-",
        "Dir::State::lists": apt / "lists",
        "Dir::State::status": apt / "status",
        "Dir::Cache": apt,
        "Dir::Cache::archives": apt / "archives",
        "APT::Install-Recommends": "false",
        "APT::Sandbox::User": pwd.getpwuid(os.geteuid()).pw_name,
        "Debug::NoLocking": "true",
    }
    options = [f"-o{name}={value}" for name, value in settings.items()]
    _tool("apt-get", *options, "--error-on=any", "update")
    _tool("apt-get", *options, "--yes", "--download-only", "install", *PACKAGES)
    return sorted((apt / "archives").glob("*.deb"))


def _tool(*command: str) -> None:
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=DEBIAN_WAIT_S
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NoDebianPackages(str(error)) from error
    if done.returncode:
        said = " / ".join(done.stderr.strip().splitlines()[-3:])
        raise NoDebianPackages(f"{command[0]}: {said or f'exit {done.returncode}'}")


def _start(root: Path, data: Path) -> str:
    if os.geteuid() == 0:
        shutil.chown(data, server_user(), server_user())
    inside = "/" / data.relative_to(root)
    _inside(
        root, f"{PROGRAMS}/initdb", "--pgdata", str(inside), "--username", "postgres",
        "--auth", "trust", "--encoding", "UTF8", "--locale", "C", "--no-sync",
    )  # fmt: skip
    settings = {
        **CARELESS, "listen_addresses": "", "unix_socket_directories": str(inside), "jit": "off",
        "max_connections": "64", "dynamic_shared_memory_type": "mmap",
    }  # fmt: skip
    with (data / "postgresql.auto.conf").open("a") as file:
        file.writelines(f"{name} = '{value}'\n" for name, value in settings.items())
    _inside(
        root, f"{PROGRAMS}/pg_ctl", "start", "--wait", "--pgdata", str(inside),
        "--log", str(inside / "server.log"),
    )  # fmt: skip
    url = f"postgresql://postgres@/postgres?host={quote(str(data), safe='')}"
    psycopg.connect(url).close()
    return url


def _stop(root: Path, data: Path) -> None:
    if (data / "postmaster.pid").exists():
        inside = "/" / data.relative_to(root)
        _inside(root, f"{PROGRAMS}/pg_ctl", "stop", "--mode", "immediate", "--pgdata", str(inside))
    shutil.rmtree(data)


def _inside(root: Path, *command: str) -> None:
    """Run a program as the server's user with ``root`` as its root folder."""
    identity = server_identity()
    enter = ["unshare", "--root", str(root)]
    if identity:
        user = pwd.getpwnam(identity["user"])
        enter += ["--setuid", str(user.pw_uid), "--setgid", str(user.pw_gid)]
    else:
        enter += ["--user", "--map-current-user"]
    with tempfile.TemporaryFile("w+") as said:  # a pipe would stay open in the server
        done = subprocess.run(
            [*enter, *command], stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT,
            check=False, timeout=DEBIAN_WAIT_S, start_new_session=True, env={"PATH": "/usr/bin"},
        )  # fmt: skip
        said.seek(0)
        assert done.returncode == 0, said.read()


_NAME = re.compile(r"mapfold-test-([0-9]+)")
_LOCK = "run.lock"


def hold_run(home: Path) -> IO[bytes]:
    """Make the folder of a run, which is kept as long as one of its processes has this file open.
    The kernel closes it, however a process ends."""
    home.mkdir(parents=True, exist_ok=True)
    held = (home / _LOCK).open("ab")
    fcntl.flock(held, fcntl.LOCK_SH)
    return held


def remove_killed_runs(parent: Path) -> list[Path]:
    """Remove the folders of runs of which no process is left; returns them.

    Both must say so, the lock and the number in the name: a run that has just begun has no lock
    yet, and the workers of a killed one go on for a moment.
    """
    removed = []
    for folder in sorted(parent.glob("mapfold-test-*")):
        named = _NAME.fullmatch(folder.name)
        if named is None or _is_alive(int(named[1])):
            continue
        with contextlib.suppress(OSError, EmbeddedServerError), (folder / _LOCK).open("ab") as held:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)  # BlockingIOError: somebody has it
            homes = [folder, *(data.parent for data in folder.glob("*/pg"))]
            if not any(EmbeddedServer(home).stop(discard_keep=True) for home in homes):
                shutil.rmtree(folder)
                removed.append(folder)
    return removed


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
