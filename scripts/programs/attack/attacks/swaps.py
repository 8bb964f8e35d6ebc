"""Questions while replays put one map in the place of another and connections to the database are
ended: each answer is of one of the two maps, or an error that says so. Before that hostile
selectors over Zenoh, and askers that do not wait for their answers."""

import json
import random
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from eventsrc.record.transport.session import Session, ZenohOptions, open_session
from projections.postgres.connection import connect
from scripts.programs.attack.arena import Arena
from scripts.programs.attack.honest_client import question
from scripts.programs.attack.service import serve
from tests.support.logs import walk, write_log

PATIENCE_S = 30.0
SWAPS = 6
SESSIONS = 1_500
LEFT = 200
PLACES = "mapfold/state/places?limit=1000"
SELECTORS = (
    *("relocalize?top=;;;=;", "relocalize?top=3;top=9", "relocalize?session=" + "x" * 3_000),
    *("relocalize?session=\u202e\u2066", "relocalize?=", "relocalize?%00=%ff", "relocalize?a=b|c"),
    *("relocalize?_time=[now(-1s)..];_anyke", "relocalize?method=joint;method=plain", "*", "**"),
    *("state/places?limit=1e3", "state/places?limit=\u0663", "state/objects?cursor=-1", "state/*"),
    *("state/places?cursor=99999999999999", "state/objects?cursor=9&cursor=8", "state/places/x/y"),
    *("state/places?x=nan;y=nan", "state/places?x=1e308;y=-1e308", "state/objects?limit=1;limit="),
)
PIECES = ("?", ";", "=", "%ff", "\u202e", "9" * 400, "*", "x=1;y=1", "session=a", "[", "\x00")
ENCODINGS = ("image/png", "zenoh/bytes;\u202e", "x" * 100)


def attack(arena: Arena) -> None:
    """Hostile selectors first, then the swaps."""
    endpoint = arena.router()
    service = serve(arena, endpoint)
    with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
        for selector in SELECTORS if arena.round == 0 else _selectors(arena.rng):
            _ask(arena, session, f"mapfold/{selector}", question())
        for encoding in ENCODINGS:
            for reply in session.raw.get(
                "mapfold/relocalize",
                payload=arena.rng.randbytes(200),
                encoding=encoding,
                attachment=arena.rng.randbytes(300),
                timeout=PATIENCE_S,
            ):
                _judge(
                    arena,
                    encoding,
                    reply.ok is not None,
                    (reply.ok or reply.err).payload.to_bytes(),
                )  # type: ignore[union-attr]
        for number in range(SESSIONS if arena.round == 0 else 50):
            _ask(arena, session, f"mapfold/relocalize?session=robot-{number}", question())
        with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as hasty:
            for _ in range(LEFT):
                hasty.raw.get("mapfold/relocalize", payload=question(), timeout=0.001)
        _swap(arena, session)
    arena.finish(service.server, codes=(0,))


def _swap(arena: Arena, session: Session) -> None:
    logs = (
        write_log(arena.folder / "first", walk(60, seed=3)),
        write_log(arena.folder / "second", walk(60, seed=4, run_id="run-other")),
    )
    right = [_answers_of(arena, session, log) for log in logs]
    if right[0] == right[1]:
        arena.complain("the two maps give the same answers")
    over = threading.Event()

    def ask_on() -> None:
        while not over.is_set():
            for number, selector in enumerate(("mapfold/relocalize", PLACES)):
                good, answer = _ask(arena, session, selector, question())
                if good and answer not in [each[number] for each in right]:
                    arena.complain(f"{selector}: an answer of neither map: {str(answer)[:300]}")

    with ThreadPoolExecutor(2) as askers:
        asking = [askers.submit(ask_on) for _ in range(2)]
        try:
            for swap in range(SWAPS):
                _replay(arena, logs[swap % 2])
                with connect(arena.database(), autocommit=True) as killer:
                    killer.execute(
                        "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
                        " WHERE application_name = 'mapfold serve'"
                    )
        finally:
            over.set()
        for each in asking:
            each.result()


def _replay(arena: Arena, log: Path) -> None:
    arena.run("reader", "replay", log, "--db", arena.database(), codes=(0,))


def _answers_of(arena: Arena, session: Session, log: Path) -> tuple[Any, Any]:
    _replay(arena, log)
    asked = (("mapfold/relocalize", question()), (PLACES, b""))
    found = [_ask(arena, session, selector, payload) for selector, payload in asked]
    if not all(good for good, _ in found):
        arena.complain(f"{log.name}: no answers: {found}")
    return found[0][1], found[1][1]


def _selectors(rng: random.Random) -> Iterator[str]:
    for _ in range(40):
        key = rng.choice(("relocalize?", "state/places?", "state/objects?"))
        yield key + "".join(rng.choices(PIECES, k=rng.randint(1, 6)))


def _ask(arena: Arena, session: Session, selector: str, payload: bytes) -> tuple[bool, Any]:
    """The reply; each must be JSON, and a refusal one that says what is wrong."""
    replies = session.get_replies(selector, payload, timeout_s=PATIENCE_S)
    if not replies:
        arena.complain(f"{selector[:200]!r}: no reply within {PATIENCE_S:g} s")
        return False, None
    return next(_judge(arena, selector, good, answer) for good, answer in replies)


def _judge(arena: Arena, asked: str, good: bool, answer: bytes) -> tuple[bool, Any]:
    document = json.loads(answer)
    kinds = ("bad_question", "too_much", "database")
    if not good and document["error"]["kind"] not in kinds:
        arena.complain(f"{asked[:200]!r}: {answer[:300]!r}")
    return good, document
