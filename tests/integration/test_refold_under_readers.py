"""Readers and a service ask in a loop while a tail refolds: no failed and no half answer."""

import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.model import Offset
from projections.fold.settings import Settings
from projections.postgres import TailProgress, rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.cypher import connect_for_cypher
from projections.surfaces.serve import Answerer, Pools
from tests.integration.test_rebuild_under_readers import (
    COUNT_LABELS,
    COUNT_PATHS,
    COUNT_VECTORS,
    HALF,
    PAUSE_S,
    Reader,
    single_answer,
)
from tests.support.logs import (
    append_command,
    bridge,
    forget_keyframes,
    keep_apart,
    name_place,
    undo,
    walk,
    write_log,
)
from tests.support.thorough import mostly_slow, rounds

SETTINGS = Settings()
WAIT_S = 60.0
ROUNDS = rounds(3, 1)
NAMES = (
    "SELECT * FROM cypher('semantic_map', $$ MATCH (p:Place) RETURN count(p.name) $$) AS (n agtype)"
)


class Asker(threading.Thread):
    """Asks a service until it is stopped; keeps every answer and every error."""

    def __init__(self, ask: Callable[[], str]) -> None:
        super().__init__()
        self.ask = ask
        self.answers: list[str] = []
        self.errors: list[Exception] = []
        self.stop = threading.Event()

    def run(self) -> None:
        while not self.stop.is_set():
            try:
                self.answers.append(self.ask())
            except Exception as error:  # noqa: BLE001 - counted by the test
                self.errors.append(error)
                return
            self.stop.wait(PAUSE_S)


@pytest.mark.parametrize("what", mostly_slow(["places", "keyframes"]))
def test_readers_see_one_map_or_the_other_and_never_an_error(
    tmp_path: Path, one_database: Targets, what: str
) -> None:
    documents = walk(HALF, rooms=2) + list(bridge()) + walk(HALF, first=HALF)
    log = write_log(tmp_path / "log", documents)
    append_command(log, name_place(0, "kitchen"))
    question = json.dumps({"crops": next(d["detections"] for d in documents if embedded(d))})
    url, queries = one_database.graph_url, (COUNT_PATHS, COUNT_LABELS, COUNT_VECTORS, NAMES)
    rooms = [in_room(documents, 0.0), in_room(documents, 6.0)]
    given = keep_apart(*rooms) if what == "places" else forget_keyframes(10, 60)
    rebuild(log, one_database, SETTINGS)
    with Pools(one_database, 2, lambda _: None) as pools:
        answerer = Answerer(pools, per_second=10_000.0)

        def ask() -> str:
            answer = answerer.relocalize(question.encode(), {})
            return json.dumps([answer["places"], answer["pose"]])

        allowed: dict[str, set[str]] = {query: set() for query in (*queries, "service")}
        for command in (None, given):
            if command is not None:
                append_command(log, command)
            rebuild(log, one_database, SETTINGS)
            with connect_for_cypher(url) as connection:
                for query in queries:
                    allowed[query].add(single_answer(connection, query))
            allowed["service"].add(ask())
        assert len(allowed["service"]) == 2
        readers = [Reader(lambda: connect_for_cypher(url), query, True) for query in queries]
        asker = Asker(ask)
        progress, stop = TailProgress(), threading.Event()
        with ThreadPoolExecutor(1) as pool:
            running = pool.submit(tail, log, one_database, SETTINGS, stop=stop, progress=progress)
            for thread in (*readers, asker):
                thread.start()
            try:
                assert all(reader.first.wait(WAIT_S) for reader in readers)
                for _ in range(ROUNDS):
                    at = append_command(log, undo(given))
                    assert progress.wait(Offset(at + 1), WAIT_S)
                    given = given.model_copy(update={"command_id": f"{given.command_id}+"})
                    at = append_command(log, given)
                    assert progress.wait(Offset(at + 1), WAIT_S)
            finally:
                for thread in (*readers, asker):
                    thread.stop.set()
                    thread.join(WAIT_S)
                stop.set()
            assert running.result(WAIT_S).refolds == 2 * ROUNDS
    for reader in readers:
        assert reader.errors == []
        assert set(reader.answers) <= allowed[reader.query]
        assert len(reader.answers) > ROUNDS
    assert asker.errors == []
    assert set(asker.answers) <= allowed["service"]
    assert len(asker.answers) > ROUNDS


def embedded(document: dict[str, object]) -> bool:
    seen = document["detections"]
    return isinstance(seen, list) and bool(seen) and all("embedding" in d for d in seen)


def in_room(documents: list[dict[str, Any]], x: float) -> int:
    """A keyframe of the first run in the middle of a room."""
    poses = ((d["keyframe_id"], d.get("map_x")) for d in documents)
    return next(int(k) for k, at in poses if at is not None and abs(at - x) < 0.5)
