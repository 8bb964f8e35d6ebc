"""What a command listens on, trusts and prints without or with malformed configuration: addresses,
passwords, and folders that another user may have made."""

import os
import shutil
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from scripts.programs.attack.arena import Arena
from scripts.programs.attack.service import replayed

PATIENCE_S = 30.0
LONG = "n" * 100
SECRET = "S3CRET"
MALFORMED = (
    f"host=h password={SECRET}",
    f"password={SECRET} host=h dbname=x bogus",
    f"postgresql://h/db?password={SECRET}&foo=bar",
    f"postgresql://user:{SECRET}/x@h/db",
    f"postgresql://user:x/{SECRET}@h:1/db",
    f"postgresql://user:{SECRET}@x@h:port/db",
    f"postgres//user:{SECRET}@h/db",
    f"postgresql://user:%zz{SECRET}@h/db",
    f"{SECRET}",
)
NOBODY = 65534


def attack(arena: Arena) -> None:
    """Every round the same: it has little randomness, and it is quick."""
    arena.attempt("router", partial(_router_listens_on_loopback, arena))
    arena.attempt("token", partial(_serve_demands_a_token, arena))
    for url in MALFORMED if arena.round == 0 else [arena.rng.choice(MALFORMED)]:
        arena.attempt("password", partial(_password_is_not_printed, arena, url))
    arena.attempt("link", partial(_link_is_not_followed, arena))
    arena.attempt("foreign server", partial(_foreign_server_is_not_used, arena))


def _router_listens_on_loopback(arena: Arena) -> None:
    config = arena.folder / "router.json5"
    config.write_text("{ transport: { unicast: { max_sessions: 10 } } }")
    router = arena.start("router", "router", "--zenoh-config", config)
    with suppress(AssertionError):  # it ends, because another program listens there
        said = router.wait_for("router listening on ")
        places = said.removeprefix("router listening on ").split("; ")[0].split(", ")
        for place in places:
            if not place.startswith(("tcp/127.0.0.1:", "tcp/[::1]:")):
                arena.complain(f"a router that was told no address listens on {place}")
        router.end(signal.SIGINT)


def _serve_demands_a_token(arena: Arena) -> None:
    arguments = ["--http", "0.0.0.0:0", "--no-zenoh", "--db", replayed(arena)]
    arena.run("server", "serve", *arguments, codes=(2,), patience_s=PATIENCE_S)


def _password_is_not_printed(arena: Arena, url: str) -> None:
    attacked = arena.run("reader", "find", "MATCH (n) RETURN n", "--db", url, codes=(1, 2))
    said = attacked.output() + "\n".join(attacked.lines)
    if SECRET in said:
        arena.complain(f"a password is printed: {said[:300]}")


def _link_is_not_followed(arena: Arena) -> None:
    """Where the socket of a server with a long path would stand, there is a link to a folder."""
    target = arena.folder / "target"
    target.mkdir(mode=0o755)
    before = _rights(target)
    home = arena.folder / LONG / "linked"
    with _taken(arena, home) as place:
        place.symlink_to(target)
        _start_and_stop(arena, home)
        if _rights(target) != before or any(target.iterdir()):
            arena.complain(f"a link at {place} was followed")


def _foreign_server_is_not_used(arena: Arena) -> None:
    """Somebody else's server answers where ours would."""
    home = arena.folder / LONG / "strange"
    with _taken(arena, home) as place, socket.socket(socket.AF_UNIX) as listener:
        place.mkdir(mode=0o700)
        if os.getuid() == 0:
            os.chown(place, NOBODY, NOBODY)
        listener.bind(str(place / ".s.PGSQL.5432"))
        listener.listen()
        listener.settimeout(0.0)
        _start_and_stop(arena, home)
        for connection in _accepted(listener):
            with connection:
                connection.settimeout(0.0)
                with suppress(OSError):
                    if connection.recv(1):
                        arena.complain("another user's server was taken for ours")


def _accepted(listener: socket.socket) -> Iterator[socket.socket]:
    with suppress(BlockingIOError):
        while True:
            yield listener.accept()[0]


def _start_and_stop(arena: Arena, home: Path) -> str:
    """The server's URL, or nothing when it does not start."""
    env = {"MAPFOLD_HOME": str(home)}
    started = arena.run("server", "db", "start", env=env, patience_s=PATIENCE_S)
    if started.process.returncode != 0:
        return ""
    arena.run("server", "db", "stop", env=env, codes=(0,))
    return started.output().splitlines()[0]


@contextmanager
def _taken(arena: Arena, home: Path) -> Iterator[Path]:
    """The folder for the socket of the server of ``home``, as a reboot leaves it: gone, its name
    known to every process. It is gone again in the end."""
    url = _start_and_stop(arena, home)
    (text,) = parse_qs(urlsplit(url).query)["host"]
    place = Path(text)
    assert not place.is_relative_to(home), "the path is not long enough to be attacked"
    shutil.rmtree(place, ignore_errors=True)
    try:
        yield place
    finally:
        if place.is_symlink():
            place.unlink()
        shutil.rmtree(place, ignore_errors=True)


def _rights(path: Path) -> tuple[int, int, int]:
    status = path.stat()
    return status.st_mode, status.st_uid, status.st_gid
