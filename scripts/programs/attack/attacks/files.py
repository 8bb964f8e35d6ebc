"""The active segment is truncated, renamed, replaced or deleted while a recorder writes it.

Its events are gone; but what is acknowledged from then on must be in the log, whether the recorder
goes on in a new segment or stops.
"""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

from scripts.programs.attack.arena import Arena
from scripts.programs.attack.oracle import Oracle
from scripts.programs.attack.robot import Robot

FLUSH_S = 20.0
SHORT_S = 3.0


def cut(active: Path, _: Arena) -> None:
    """Leave nothing of it."""
    with active.open("r+b") as file:
        file.truncate(0)


def cut_somewhere(active: Path, arena: Arena) -> None:
    """Leave a part of it."""
    with active.open("r+b") as file:
        file.truncate(arena.rng.randrange(1, active.stat().st_size))


def rename(active: Path, _: Arena) -> None:
    """Move it out of the log."""
    active.rename(active.parent.parent / "taken")


def replace(active: Path, _: Arena) -> None:
    """Put a copy in its place, to which no process writes."""
    copy = active.with_name("copy")
    shutil.copyfile(active, copy)
    copy.replace(active)


def delete(active: Path, _: Arena) -> None:
    """Unlink it."""
    active.unlink()


WAYS: tuple[Callable[[Path, Arena], None], ...] = (cut, rename, replace, delete, cut_somewhere)


def attack(arena: Arena) -> None:
    """Round 0: the two ways that once made it promise what it did not have; later one at random."""
    for way in WAYS[:2] if arena.round == 0 else [arena.rng.choice(WAYS)]:
        arena.attempt(way.__name__, partial(_one, arena, way))


def _one(arena: Arena, way: Callable[[Path, Arena], None]) -> None:
    log, oracle, endpoint = arena.folder / f"log-{way.__name__}", Oracle(), arena.router()
    spool = arena.folder / f"spool-{way.__name__}"
    recorder = arena.recorder(log, endpoint)
    with Robot(endpoint, spool, oracle, run_id="run", per_second=1.0) as robot:
        for _ in range(20):
            robot.publish()
        if not robot.publisher.flush(FLUSH_S):
            arena.complain("nothing was acknowledged")
        robot.note_acknowledged()
        (active,) = log.glob("*.active")
        way(active, arena)
        oracle.destroyed |= robot.sent
        for _ in range(20):
            robot.publish()
        robot.publisher.flush(SHORT_S)
        if recorder.running:
            recorder.kill()
        robot.note_acknowledged()
    if any(log.glob("*.mcap*")):
        arena.run("reader", "log", "recover", log)
        arena.judge(oracle, log)
