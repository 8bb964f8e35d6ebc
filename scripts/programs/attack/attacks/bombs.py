"""Decompression bombs, and files that claim to be large: each command refuses or reads them in
bounded memory and time."""

import sqlite3
from collections.abc import Callable
from functools import partial
from pathlib import Path

from eventsrc.log import LogWriter
from eventsrc.ros.messages import DETECTIONS
from scripts.programs.attack.arena import Arena
from scripts.programs.attack.bomb_files import (
    gzip_line,
    mcap_with,
    mcap_with_large_message,
    zstd_chunk,
)
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import BY_HAND, KEY
from tests.support.ros_bags import Raw, write_bag

GB = 1_000_000_000
UNFOLDED = 3_200_000_000
PATIENCE_S = 60.0


def zstd_import(arena: Arena) -> None:
    """98 kB of an MCAP file are 3.2 GB of a chunk."""
    bomb = arena.folder / "bomb.mcap"
    mcap_with(bomb, zstd_chunk(UNFOLDED))
    _import(arena, bomb)


def zstd_import_with_false_size(arena: Arena) -> None:
    """Like `zstd_import`, but the head of the chunk says 100 bytes."""
    bomb = arena.folder / "liar.mcap"
    mcap_with(bomb, zstd_chunk(UNFOLDED, said=100))
    _import(arena, bomb)


def large_message(arena: Arena) -> None:
    """One message of 300 MB."""
    bomb = arena.folder / "large.mcap"
    mcap_with_large_message(bomb, 300_000_000)
    _import(arena, bomb)


def large_message_in_sqlite(arena: Arena) -> None:
    """A message of 200 to 900 MB in a bag of ROS 2."""
    bomb = write_bag(arena.folder / "large", [("/detections", 1, Raw(DETECTIONS, b"?"))], "sqlite")
    with sqlite3.connect(bomb / "large.db3") as database:
        size = arena.rng.randrange(200, 900) * 1_000_000
        database.execute("UPDATE messages SET data = zeroblob(?)", (size,))
    database.close()
    _import(arena, bomb)


def gzip_import(arena: Arena) -> None:
    """A line of 2 GB in 9 MB."""
    bomb = arena.folder / "bomb.jsonl.gz"
    gzip_line(bomb, 2 * GB)
    _import(arena, bomb)


def sparse_segment(arena: Arena) -> None:
    """A growing segment of 20 GB that takes no room on the disk."""
    log = _log(arena, "sparse")
    (active,) = log.glob("*.active")
    with active.open("r+b") as file:
        file.truncate(20 * GB)
    _read(arena, log)


def zstd_in_segment(arena: Arena) -> None:
    """A bomb stands behind the last chunk of a growing segment."""
    log = _log(arena, "bomb")
    (active,) = log.glob("*.active")
    with active.open("ab") as file:
        file.write(zstd_chunk(UNFOLDED))
    _read(arena, log)


CASES: tuple[Callable[[Arena], None], ...] = (
    *(zstd_import, zstd_import_with_false_size, large_message, gzip_import),
    large_message_in_sqlite,
    *(sparse_segment, zstd_in_segment),
)


def attack(arena: Arena) -> None:
    """Round 0: all of them; later one at random."""
    for bomb in CASES if arena.round == 0 else [arena.rng.choice(CASES)]:
        arena.attempt(bomb.__name__, partial(bomb, arena))


def _import(arena: Arena, bomb: Path) -> None:
    log = arena.folder / f"{bomb.name}.log"
    arena.run("reader", "import", log, bomb, codes=(1, 2, 3), patience_s=PATIENCE_S)


def _log(arena: Arena, name: str) -> Path:
    """A log of ten events that was not closed."""
    log = arena.folder / name
    writer = LogWriter(log, fsync=BY_HAND)
    for k in range(10):
        writer.append(KEY, payload(envelope(k)))
    writer.sync()
    writer._sealer.finish()
    writer._active.close()
    writer._lock.release()
    return log


def _read(arena: Arena, log: Path) -> None:
    for command in ("verify", "info", "recover"):
        arena.run("reader", "log", command, log, codes=(0, 1, 3), patience_s=PATIENCE_S)
    said = arena.run("reader", "log", "cat", log, "--json", codes=(0,), patience_s=PATIENCE_S)
    if said.output().count("\n") < 10:
        arena.complain(f"{log.name}: {said.output().count(chr(10))} of 10 events are left")
