"""Folders, links and servers of other users are not used for the embedded server's socket."""

import contextlib
import itertools
import os
import pwd
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psycopg
import pytest

from projections.fold.map_errors import DatabaseUnavailable, EmbeddedServerError
from projections.postgres import server_user
from projections.postgres.connection import connect
from projections.postgres.embedded import EmbeddedServer
from tests.support.servers import furnish

NOBODY = 65534
SOCKET = ".s.PGSQL.5432"
WAIT_S = 60
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root to act as another user")

ROGUE = """
import os, socket, sys
folder, user = sys.argv[1], int(sys.argv[2])
os.setgroups([])
os.setgid(user)
os.setuid(user)
os.makedirs(folder, mode=0o755, exist_ok=True)
with socket.socket(socket.AF_UNIX) as door:
    door.bind(os.path.join(folder, ".s.PGSQL.5432"))
    os.chmod(os.path.join(folder, ".s.PGSQL.5432"), 0o777)
    door.listen()
    print("listening", flush=True)
    while True:
        caller, _ = door.accept()
        with caller:
            print(len(caller.recv(100)), flush=True)
"""
"""Listens on the server's socket, and prints how many bytes each client sends: 0 for none."""
LAST = b"x"
"""Shorter than anything a client of PostgreSQL begins with."""


@contextlib.contextmanager
def rogue(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another user's process that listens in ``folder``, which it makes if it is not there."""
    process = subprocess.Popen(
        [sys.executable, "-I", "-c", ROGUE, str(folder), str(NOBODY)],
        stdout=subprocess.PIPE,
        text=True,
        cwd="/",
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "listening\n"
        yield process
    finally:
        process.kill()
        process.wait(WAIT_S)
        assert process.stdout is not None
        process.stdout.close()


def heard(process: subprocess.Popen[str], door: Path) -> list[str]:
    """How many bytes each client has sent until now."""
    with socket.socket(socket.AF_UNIX) as last:
        last.connect(str(door))
        last.sendall(LAST)
    assert process.stdout is not None
    lines = iter(process.stdout.readline, "")
    return list(itertools.takewhile(lambda said: said != str(len(LAST)), map(str.strip, lines)))


@pytest.fixture
def folders() -> Iterator[list[Path]]:
    """Folders to remove in the end."""
    made: list[Path] = []
    yield made
    for folder in made:
        if folder.is_symlink():
            folder.unlink()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def home(folders: list[Path]) -> Iterator[Path]:
    """A home for a server, its path too long for a socket."""
    top = Path(tempfile.mkdtemp(prefix="mapfold-test-long-"))
    folders.append(top)
    deep = top / ("d" * 60) / ("e" * 60)
    yield furnish(deep)
    EmbeddedServer(deep).stop(discard_keep=True)


@pytest.fixture
def short_home(folders: list[Path]) -> Iterator[Path]:
    """A home for a server whose socket is in its data folder."""
    top = Path(tempfile.mkdtemp(prefix="mapfold-test-short-"))
    folders.append(top)
    yield furnish(top)
    with contextlib.suppress(EmbeddedServerError):
        EmbeddedServer(top).stop(discard_keep=True)


def socket_folder(server: EmbeddedServer) -> Path:
    """The folder that clients are sent to."""
    return Path(parse_qs(urlsplit(server.url).query)["host"][0])


def data_served(server: EmbeddedServer) -> Path:
    """The data folder of the server that answers."""
    with psycopg.connect(server.url, connect_timeout=WAIT_S) as connection:
        row = connection.execute("SHOW data_directory").fetchone()
    assert row is not None
    return Path(row[0])


def started_once(home: Path, folders: list[Path]) -> Path:
    """The socket folder of a server that has run and is stopped, removed."""
    with EmbeddedServer(home) as server:
        folder = socket_folder(server)
    folders.append(folder)
    shutil.rmtree(folder)
    return folder


def test_it_is_made_for_the_server_alone_and_found_again(home: Path, folders: list[Path]) -> None:
    with EmbeddedServer(home) as server:
        folder = socket_folder(server)
        folders.append(folder)
        status = folder.lstat()
        assert status.st_mode & 0o777 == 0o700
        assert status.st_uid == server.data.stat().st_uid
        assert str(os.getuid()) not in folder.name.split("-")
        assert EmbeddedServer(home).running
        assert socket_folder(EmbeddedServer(home)) == folder
    with EmbeddedServer(home) as server:
        assert socket_folder(server) == folder


@pytest.mark.slow
def test_a_removed_folder_is_made_again_under_the_same_name(
    home: Path, folders: list[Path]
) -> None:
    folder = started_once(home, folders)
    with EmbeddedServer(home) as server:
        assert socket_folder(server) == folder
        assert data_served(server).samefile(server.data)


@pytest.mark.slow
def test_before_the_first_start_there_is_no_url(home: Path) -> None:
    server = EmbeddedServer(home)
    assert not server.running
    with pytest.raises(EmbeddedServerError, match="run `mapfold db start"):
        _ = server.url


@pytest.mark.slow
@needs_root
def test_another_users_folder_and_server_are_left_alone(home: Path, folders: list[Path]) -> None:
    folder = started_once(home, folders)
    with rogue(folder) as other:
        assert not EmbeddedServer(home).running
        with EmbeddedServer(home) as server:
            folders.append(socket_folder(server))
            assert socket_folder(server) != folder
            assert data_served(server).samefile(server.data)
        assert folder.stat().st_uid == NOBODY
        assert heard(other, folder / SOCKET) == []


@pytest.mark.slow
def test_a_link_is_not_followed(home: Path, folders: list[Path], tmp_path: Path) -> None:
    folder = started_once(home, folders)
    victim = tmp_path / "victim"
    victim.mkdir(mode=0o700)
    before = victim.stat()
    folder.symlink_to(victim)
    with EmbeddedServer(home) as server:
        folders.append(socket_folder(server))
        assert socket_folder(server) != folder
        assert data_served(server).samefile(server.data)
    after = victim.stat()
    assert (after.st_uid, after.st_gid, after.st_mode) == (
        before.st_uid, before.st_gid, before.st_mode,
    )  # fmt: skip
    assert not list(victim.iterdir())


def test_a_folder_that_others_may_enter_is_not_used(home: Path, folders: list[Path]) -> None:
    folder = started_once(home, folders)
    folder.mkdir()
    folder.chmod(0o777)
    with EmbeddedServer(home) as server:
        folders.append(socket_folder(server))
        assert socket_folder(server) != folder


@pytest.mark.slow
def test_the_copy_of_a_home_is_a_server_of_its_own(home: Path, folders: list[Path]) -> None:
    with EmbeddedServer(home):
        pass
    copy = home.with_name("c" * 60)
    subprocess.run(["cp", "-a", str(home), str(copy)], check=True)
    with EmbeddedServer(home) as server, EmbeddedServer(copy) as other:
        folders.extend([socket_folder(server), socket_folder(other)])
        assert data_served(server).samefile(home / "pg")
        assert data_served(other).samefile(copy / "pg")


@pytest.mark.slow
@needs_root
def test_clients_do_not_talk_to_another_users_server(
    short_home: Path, folders: list[Path], tmp_path_factory: pytest.TempPathFactory
) -> None:
    with EmbeddedServer(short_home) as server:
        url = server.url
    theirs = Path(tempfile.mkdtemp(prefix="mapfold-test-rogue-"))
    folders.append(theirs)
    os.chown(theirs, NOBODY, NOBODY)
    with rogue(theirs) as other:
        (theirs / SOCKET).rename(server.data / SOCKET)
        with pytest.raises(DatabaseUnavailable, match="another user's server answers there"):
            connect(url)
        with pytest.raises(EmbeddedServerError, match="it belongs to another user"):
            EmbeddedServer(short_home).start()
        assert set(heard(other, server.data / SOCKET)) == {"0"}
    (server.data / SOCKET).unlink()


@pytest.mark.slow
def test_a_server_of_another_data_folder_is_refused(
    short_home: Path, folders: list[Path], pg_server: EmbeddedServer
) -> None:
    with EmbeddedServer(short_home) as server:
        pass
    (server.data / SOCKET).symlink_to(socket_folder(pg_server) / SOCKET)
    try:
        with pytest.raises(EmbeddedServerError, match="another server answers on its socket"):
            EmbeddedServer(short_home).start()
    finally:
        (server.data / SOCKET).unlink()


@pytest.mark.slow
@needs_root
def test_another_users_data_folder_is_refused(short_home: Path) -> None:
    with EmbeddedServer(short_home) as server:
        owner = server.data.stat().st_uid
    os.chown(server.data, NOBODY, NOBODY)
    refused = f"of user {NOBODY}, mode 700"
    with pytest.raises(EmbeddedServerError, match=refused):
        EmbeddedServer(short_home).start()
    with pytest.raises(EmbeddedServerError, match=refused):
        _ = EmbeddedServer(short_home).running
    os.chown(server.data, owner, owner)


@needs_root
def test_the_user_of_the_server_is_made_where_the_path_lacks_useradd(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = f"pgserver-test-{os.getpid()}"
    monkeypatch.setattr(server_user, "SYSTEM_USER", name)
    with monkeypatch.context() as patched:
        patched.setenv("PATH", "/no-such-folder")
        try:
            assert server_user.server_identity()["user"] == name
            assert pwd.getpwnam(name).pw_uid == server_user.server_uid()
        finally:
            subprocess.run(["/usr/sbin/userdel", name], check=True, capture_output=True)


@pytest.mark.slow
def test_the_url_names_the_user_of_the_server(short_home: Path) -> None:
    with EmbeddedServer(short_home) as server:
        user = parse_qs(urlsplit(server.url).query)["requirepeer"][0]
        assert pwd.getpwnam(user).pw_uid == server.data.stat().st_uid
