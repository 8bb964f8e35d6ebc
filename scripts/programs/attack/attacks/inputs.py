"""Options, files and bags that no program should be given: each ends in a sentence, and soon."""

import os
import sqlite3
from collections.abc import Callable
from functools import partial
from pathlib import Path

from eventsrc.log import LogWriter
from eventsrc.ros.messages import DETECTIONS
from scripts.programs.attack.arena import Arena
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.ros_bags import Raw, write_bag

PATIENCE_S = 20.0
"""Of a command that refuses what it is given; one that waits for a FIFO takes longer."""
NINES = "9" * 5_000
_MAP = "resolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"
YAML = (
    "resolution: 0x" + "f" * 60_000,
    "resolution: " + "59:" * 20_000 + "59.5",
    "resolution: &a [*a]",
    "resolution: " + "[" * 30_000,
    "image: fifo",
    "image: /dev/zero",
)


def numbers(arena: Arena) -> None:
    """Points, ports and conditions of thousands of digits or words."""
    log = _log(arena)
    for arguments in (
        ("state", log, "--at", NINES),
        ("state", log, "--at", f"a:{NINES}"),
        ("log", "cat", log, "--from", NINES),
        ("diff", log, "1", NINES),
        ("why", log, f"keyframe:a:{NINES}"),
        ("bisect", log, " or ".join(["place_count > 1"] * 3_000)),
        ("record", log, "--metrics", NINES),
        ("record", log, "--zenoh-config", NINES),
        ("record", log, "--key", b"\xff".decode(errors="surrogateescape")),
    ):
        arena.run("reader", *arguments, codes=(2,), patience_s=PATIENCE_S)


def maps(arena: Arena) -> None:
    """YAML that is too much, and images that are no files."""
    if not (arena.folder / "fifo").exists():
        os.mkfifo(arena.folder / "fifo")
    for number, text in enumerate(YAML):
        file = arena.folder / f"{number}.yaml"
        image = "" if text.startswith("image") else "image: a.pgm\n"
        file.write_text(f"{_MAP}{image}{text}\n")
        log = arena.folder / "maps"
        arena.run("reader", "import", log, "--map", file, codes=(2,), patience_s=PATIENCE_S)


def files(arena: Arena) -> None:
    """A FIFO, a device, depth and digits for every file of an option."""
    log = _log(arena)
    fifo, deep = arena.folder / "fifo", arena.folder / "deep"
    if not fifo.exists():
        os.mkfifo(fifo)
    deep.write_text(f'{{"crops": {"[" * 50_000}')
    for file in (fifo, Path("/dev/zero"), deep):
        for arguments in (
            ("state", log, "--settings", file),
            ("relocalize", log, file),
            ("evaluate", log, "--truth", file),
            ("edit", "correct-poses", log, "a", "--trajectory", file, "--dry-run"),
        ):
            arena.run("reader", *arguments, codes=(1, 2), patience_s=PATIENCE_S)


def bags(arena: Arena) -> None:
    """SQLite whose tables are views without end, or hold other types; and cut off anywhere."""
    bag = write_bag(arena.folder / "bag", [("/detections", 1, Raw(DETECTIONS, b"?"))], "sqlite")
    whole = (bag / "bag.db3").read_bytes()
    endless = "WITH RECURSIVE n(x) AS (SELECT 4 UNION ALL SELECT x FROM n) SELECT x AS"
    for script in (
        f"DROP TABLE schema; CREATE VIEW schema AS {endless} schema_version FROM n",
        "UPDATE messages SET data = 'text'",
        "UPDATE messages SET data = 7.5",
        "UPDATE messages SET timestamp = 'soon'",
        "UPDATE messages SET timestamp = -5",
        "UPDATE messages SET timestamp = 9223372036854775807",
        "UPDATE topics SET name = x'ff', type = 5",
        "UPDATE message_definitions SET encoding = 'none'",
    ):
        with sqlite3.connect(bag / "bag.db3") as database:
            database.executescript(script)
        database.close()
        _import_bag(arena, bag)
        (bag / "bag.db3").write_bytes(whole)
    for _ in range(4):
        (bag / "bag.db3").write_bytes(whole[: arena.rng.randrange(len(whole))])
        _import_bag(arena, bag)


CASES: tuple[Callable[[Arena], None], ...] = (numbers, maps, files, bags)


def attack(arena: Arena) -> None:
    """Round 0: all of them; later one at random."""
    for case in CASES if arena.round == 0 else [arena.rng.choice(CASES)]:
        arena.attempt(case.__name__, partial(case, arena))


def _log(arena: Arena) -> Path:
    log = arena.folder / "log"
    if not log.exists():
        with LogWriter(log) as writer:
            for k in range(5):
                writer.append(KEY, payload(envelope(k)))
    return log


def _import_bag(arena: Arena, bag: Path) -> None:
    log = arena.folder / f"log-{len(list(arena.folder.iterdir()))}"
    arena.run("reader", "import", log, bag, codes=(0, 1, 2, 3), patience_s=PATIENCE_S)
