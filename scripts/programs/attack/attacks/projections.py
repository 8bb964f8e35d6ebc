"""Tails are killed, rows changed by hand, names hold control characters: in the end the databases
equal the log, or `db check` reports where they do not."""

import json
import signal
import subprocess
from contextlib import suppress
from functools import partial
from pathlib import Path

import psycopg
from psycopg import sql

from eventsrc.log import NEVER, LogWriter
from projections.postgres.cypher import connect_for_cypher
from scripts.programs.attack.arena import Arena
from tests.support.logs import walk, write_log

LONGEST_LIFE_S = 1.0
EVIL = "tb/\x1b[2J\x1b]0;owned\x07\u009b31m\u202e"
WRITES = (
    "MATCH (p:Place) SET p.owned = 1 RETURN p",
    "MATCH (p:Place) REMOVE p.place_id RETURN p",
    "MATCH ()-[e:LOCATED_IN]->() DELETE e RETURN 1",
    "MATCH (p:Place) DETACH DELETE p RETURN 1",
    "CREATE (p:Place {place_id: 'owned'}) RETURN p",
    "MERGE (p:Owned {place_id: 'owned'}) RETURN p",
)


def attack(arena: Arena) -> None:
    """Kill a tail three times, let one finish, and check; then change rows by hand."""
    url = arena.database()
    log = write_log(arena.folder / "log", walk(40, seed=arena.rng.randrange(1000)))
    arena.run("reader", "replay", log, "--until", "10", "--db", url, codes=(0,))
    for _ in range(3):
        tail = arena.start("reader", "tail", log, "--db", url)
        try:
            tail.wait(arena.rng.uniform(0.3, LONGEST_LIFE_S))
        except subprocess.TimeoutExpired:  # the wait has killed it
            assert tail.process.returncode == -signal.SIGKILL
    arena.run("reader", "tail", log, "--once", "--db", url, codes=(0,))
    arena.run("reader", "db", "check", log, "--db", url, codes=(0,))
    if arena.round == 0:
        arena.attempt("reader", partial(_read_only, arena, url))
        arena.attempt("changed rows", partial(_change_rows, arena, log, url))
        arena.attempt("characters", partial(_control_characters, arena))


def _read_only(arena: Arena, url: str) -> None:
    """The role that may only read cannot write, through Cypher either."""
    roles = arena.run("reader", "db", "roles", codes=(0,)).output()
    with psycopg.connect(url, autocommit=True) as owner:
        owner.execute(roles.encode())
        before = _places(url)
    for write in WRITES:
        with connect_for_cypher(url) as reader, suppress(psycopg.Error):
            reader.execute("SET ROLE mapfold_reader")
            reader.execute(
                sql.SQL("SELECT * FROM cypher('semantic_map', $$ {} $$) AS (x agtype)").format(
                    sql.SQL(write)
                )
            )
            arena.complain(f"mapfold_reader may write: {write}")
    if _places(url) != before:
        arena.complain("mapfold_reader has changed the places")


def _places(url: str) -> list[tuple[str]]:
    with connect_for_cypher(url) as connection:
        return connection.execute(
            "SELECT * FROM cypher('semantic_map', $$ MATCH (p:Place) RETURN properties(p) $$)"
            " AS (p agtype) ORDER BY p"
        ).fetchall()


def _change_rows(arena: Arena, log: Path, url: str) -> None:
    """A label that is none of ours is put into the graph, and one of our rows is changed."""
    with connect_for_cypher(url) as owner:
        owner.execute(
            "SELECT * FROM cypher('semantic_map', $$ CREATE (:Foreign {x: 1}) $$) AS (x agtype)"
        )
    arena.run("reader", "db", "check", log, "--db", url, codes=(3,))
    arena.run("reader", "db", "check", log, "--repair", "--db", url, codes=(0, 3))
    with connect_for_cypher(url) as owner:
        owner.execute(
            "SELECT * FROM cypher('semantic_map', $$ MATCH (p:Run) SET p.run_id = 'x' $$)"
            " AS (x agtype)"
        )
    arena.run("reader", "db", "check", log, "--db", url, codes=(3,))


def _control_characters(arena: Arena) -> None:
    """What a hostile robot wrote is shown escaped, never as it is."""
    log = arena.folder / "evil"
    with LogWriter(log, fsync=NEVER) as writer:
        for name in ("x\x1b[2J", "\x07", "\u202e"):
            document = {"run_id": f"run{name}", "keyframe_id": 1, "timestamp": 1.0, name: name}
            writer.append(EVIL, json.dumps({**document, "detections": []}).encode())
    source = arena.folder / "evil.jsonl"
    text = json.dumps({"ts": 1.0, "iso": "x", "key": EVIL, "payload": {EVIL: EVIL}})
    source.write_text(f"{text}\n")
    commands: tuple[tuple[str | Path, ...], ...] = (
        ("log", "info", log),
        ("log", "cat", log),
        ("log", "verify", log),
        ("import", arena.folder / "imported", source),
        ("state", log),
    )
    for command in commands:
        attacked = arena.run("reader", *command)
        said = attacked.output() + "\n".join(attacked.lines)
        if found := {char for char in said if _moves(char)}:
            arena.complain(f"{attacked.command} shows {sorted(found)!r} as they are")


def _moves(char: str) -> bool:
    """Whether a terminal would obey ``char`` instead of showing it."""
    return char != "\n" and (ord(char) < 0x20 or 0x7F <= ord(char) < 0xA0 or char == "\u202e")
