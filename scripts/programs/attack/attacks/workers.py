"""Commands with processes of their own, which are killed or interrupted at random moments, they or
those processes: `fleet`, `replay --workers`, `calibrate --write` and `demo`. None is left running,
and what is run again finishes."""

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit, urlunsplit

from psycopg import sql

from projections.postgres.connection import connect
from scripts.programs.attack.arena import Arena
from scripts.programs.attack.attacked_command import AttackedCommand
from scripts.programs.attack.honest_client import question
from scripts.programs.bench.fleet.killing import is_worker, processes_under
from scripts.programs.bench.fleet.speed import RunningCluster, dask_cluster
from tests.support.fleets import extend, write_sites, wrong_rows
from tests.support.logs import walk, write_log

SITES = ("a", "b", "c")
KEYFRAMES = 40
LIVES = 3
LONGEST_LIFE_S = 5.0
PATIENCE_S = 60.0
GONE_S = 20.0
POLITE = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
SIGNALS = (signal.SIGKILL, *POLITE)
Choose = Callable[[Arena, AttackedCommand], Sequence[int]]
"""Gives the processes of which one is sent a signal."""


def fleet(arena: Arena) -> None:
    """The parent and the workers of the local pool."""
    folder, template = _sites(arena)
    asked = arena.folder / "question.json"
    asked.write_bytes(question())
    others = ("verify", "status", "relocalize")
    for life in range(LIVES):
        which = "replay" if life == 0 else arena.rng.choice(("replay", *others))
        more = ("--again", "--jobs", "2") if which == "replay" else ()
        databases = () if which == "verify" else ("--db", template)
        last = (asked,) if which == "relocalize" else ()
        _attack(arena, ("fleet", which, folder, *last, *databases, *more))
        _grow(folder, life)
    _check(arena, folder, template)


def cluster(arena: Arena) -> None:
    """The client, the workers and the scheduler of a Dask cluster."""
    folder, template = _sites(arena)
    with dask_cluster(2) as running:
        engine = ("--engine", f"dask://{running.address}")
        for life, last in enumerate((False, True)):
            choose = _scheduler(running) if last else _of_cluster
            command = ("fleet", "replay", folder, "--db", template, "--again", *engine)
            _attack(arena, command, choose=choose)
            _grow(folder, life)
    _check(arena, folder, template)


def replay(arena: Arena) -> None:
    """`replay --workers` of a log that is long enough to be shared out."""
    log, url = arena.folder / "long", arena.database()
    write_log(log, walk(10_000, detections=0))
    for _ in range(2):
        _attack(arena, ("replay", log, "--db", url, "--workers", "2"))
    arena.run("reader", "replay", log, "--db", url, "--workers", "2", codes=(0,))
    arena.run("reader", "db", "check", log, "--db", url, codes=(0,))


def calibrate(arena: Arena) -> None:
    """`calibrate --write`, whose command is then in the log once, or not at all."""
    log = write_log(arena.folder / "log", walk(60, seed=arena.rng.randrange(1000)))
    ended_well = False
    for _ in range(LIVES):
        ended_well |= _attack(arena, ("calibrate", log, "--write")) == 0
        found = _commands(arena, log)
        if found > 1 or (ended_well and not found):  # it records what the log has not yet
            arena.complain(f"calibrate has written {found} commands")
    arena.run("reader", "log", "verify", log, codes=(0,))


def demo(arena: Arena) -> None:
    """`demo`, with its router, recorder and database server."""
    command = ("demo", "--out", arena.folder / "demo", "--speed", "1000")
    for _ in range(2):
        _attack(arena, command, POLITE, longest_s=15.0)
    arena.run("worker", *command, codes=(0,), patience_s=180.0)
    _check_gone(arena, "demo")


CASES: tuple[Callable[[Arena], None], ...] = (fleet, cluster, replay, calibrate, demo)


def attack(arena: Arena) -> None:
    """Round 0: all of them; later one at random."""
    for case in CASES if arena.round == 0 else [arena.rng.choice(CASES)]:
        arena.attempt(case.__name__, partial(case, arena))


def _sites(arena: Arena) -> tuple[Path, str]:
    """A folder of logs, and the template of their databases, which are dropped in the end."""
    prefix = f"attacked_{arena.rng.randbytes(4).hex()}_"
    url = arena.database()
    template = urlunsplit(urlsplit(url)._replace(path=f"/{prefix}{{site}}"))

    def drop() -> None:
        with connect(url, autocommit=True) as connection:
            for site in SITES:
                name = sql.Identifier(f"{prefix}{site}")
                connection.execute(sql.SQL("DROP DATABASE IF EXISTS {} WITH (FORCE)").format(name))

    arena.stack.callback(drop)
    return write_sites(arena.folder / prefix, [*SITES], KEYFRAMES), template


def _grow(folder: Path, life: int) -> None:
    for seed, site in enumerate(SITES):
        extend(folder / site, seed, 2, first=KEYFRAMES + 2 * life)


def _check(arena: Arena, folder: Path, template: str) -> None:
    """What is run again finishes, and every site's rows are those of its log."""
    arena.run("worker", "fleet", "replay", folder, "--db", template, codes=(0,))
    arena.run("worker", "fleet", "verify", folder, codes=(0,))
    for site in SITES:
        if wrong := wrong_rows(folder / site, template.replace("{site}", site)):
            arena.complain(f"{wrong} rows of site {site} are not those of its log")


def _commands(arena: Arena, log: Path) -> int:
    return len(json.loads(arena.run("reader", "edits", log, "--json", codes=(0,)).output()))


def _itself_or_its(arena: Arena, begun: AttackedCommand) -> Sequence[int]:
    """Mostly the command; else the processes that it has started, but for the database's."""
    itself = begun.process.pid
    under = [pid for pid, args in processes_under(itself).items() if "postgres" not in args]
    return [itself] if arena.rng.random() < 0.6 or not under else under


def _scheduler(running: RunningCluster) -> Choose:
    return lambda *_: [running.scheduler.pid]


def _of_cluster(arena: Arena, begun: AttackedCommand) -> Sequence[int]:
    itself = begun.process.pid
    workers = [pid for pid, args in processes_under(os.getpid()).items() if is_worker(args)]
    return [itself] if arena.rng.random() < 0.5 else workers


def _attack(
    arena: Arena,
    command: Sequence[str | Path],
    signals: Sequence[signal.Signals] = SIGNALS,
    *,
    choose: Choose = _itself_or_its,
    longest_s: float = LONGEST_LIFE_S,
) -> int:
    """Run a command and send it a signal at a random moment, or kill a process that works for it;
    the exit code."""
    begun = arena.start("worker", *command)
    number = arena.rng.choice(signals)
    try:
        begun.process.wait(arena.rng.uniform(0.0, longest_s))
    except subprocess.TimeoutExpired:
        target = arena.rng.choice(choose(arena, begun))
        own = target == begun.process.pid
        _send(target, number if own else signal.SIGKILL)
    else:
        own = False
    try:
        code = begun.process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        arena.complain(f"{begun.command} goes on for {PATIENCE_S:g} s after {number.name}")
        begun.process.kill()
        code = begun.process.wait()
    expected = (0, 1, 3, *((-number, 128 + number) if own else ()))
    if code not in expected:
        arena.complain(f"{begun.command} ended with {code}: {begun.lines[-2:]}")
    _check_gone(arena, begun.command)
    begun.wait()
    return code


def _send(pid: int, number: int) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:  # it has ended meanwhile
        return


def _check_gone(arena: Arena, command: str) -> None:
    """Complain of processes of the round that go on, and kill them."""
    end, pause = time.monotonic() + GONE_S, threading.Event()
    while left := _processes_of(arena.folder):
        if time.monotonic() > end:
            arena.complain(f"{command} has left behind {left}")
            for pid in left:
                _send(pid, signal.SIGKILL)
            return
        pause.wait(0.05)


def _processes_of(folder: Path) -> dict[int, str]:
    """Command lines of running processes by pid that have the round's folder in their environment
    or arguments."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            given = (process / "environ").read_bytes(), (process / "cmdline").read_bytes()
        except OSError:  # gone
            continue
        if any(str(folder).encode() in each for each in given):
            found[int(process.name)] = given[1].replace(b"\0", b" ").decode(errors="replace")[:200]
    return found
