"""PostgreSQL 17, AGE 1.5 and pgvector 0.8.0: Debian 13's packages, in a folder of their own.

apt fetches them from Debian's mirror, checked by the keys of this machine. The folder is kept (in
``$XDG_CACHE_HOME``, else ``~/.cache``); it is the root folder of the server, as its libraries are
newer than those of older systems. The server's data is made for each use and removed after it.
"""

import contextlib
import fcntl
import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from urllib.parse import quote

import psycopg

from projections.postgres.server_user import server_identity, server_user
from tests.support.servers import CARELESS

PACKAGES: Final = ("base-files", "dash", "postgresql-17-age", "postgresql-17-pgvector")
PROGRAMS: Final = "/usr/lib/postgresql/17/bin"
SOURCE: Final = (
    "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg]"
    " http://deb.debian.org/debian trixie main\n"
)
WAIT_S: Final = 300


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
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=WAIT_S)
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
            check=False, timeout=WAIT_S, start_new_session=True, env={"PATH": "/usr/bin"},
        )  # fmt: skip
        said.seek(0)
        assert done.returncode == 0, said.read()
