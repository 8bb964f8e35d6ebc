"""A served map: the log of a walk, replayed into a database, and `mapfold serve` in front of it."""

from dataclasses import dataclass
from pathlib import Path

from scripts.programs.attack.arena import Arena
from scripts.programs.attack.attacked_command import AttackedCommand
from tests.support.logs import walk, write_log


@dataclass(frozen=True, slots=True)
class Service:
    """The server, and where it answers over HTTP."""

    server: AttackedCommand
    url: str


def replayed(arena: Arena) -> str:
    """The URL of a database that holds the map of a walk."""
    log = write_log(arena.folder / "walk", walk(60, seed=3))
    arena.run("reader", "replay", log, "--db", arena.database(), codes=(0,))
    return arena.database()


def serve(arena: Arena, endpoint: str | None = None, *options: str | Path) -> Service:
    """Replay and serve with ``options``, over Zenoh too when there is an ``endpoint``."""
    url = replayed(arena)
    zenoh = ["--no-zenoh"] if endpoint is None else ["--connect", endpoint]
    server = arena.start("server", "serve", "--http", "127.0.0.1:0", "--db", url, *zenoh, *options)
    said = server.wait_for("answering http")
    server.wait_for("Ctrl-C")
    return Service(server, said.split()[1].rstrip(","))
