"""Commands in the log while a tail follows it: delay of a name, and a refold against a rebuild."""

import multiprocessing
import shutil
import threading
import time
from collections import Counter
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import psycopg

from eventsrc.envelope.commands import Anchor, Command, KeepApart, NamePlace, encode_command
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter, parse_fsync
from projections.fold.settings import Settings
from projections.postgres import TailProgress, rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.cypher import connect_for_cypher
from projections.postgres.embedded import EmbeddedServer

from .world import make_log

KEYFRAMES = 100_000
WAIT_S = 600.0
NAMES = (
    "SELECT * FROM cypher('semantic_map', $$ MATCH (p:Place) RETURN count(p.name) $$) AS (n agtype)"
)
QUERIES = {
    "names": NAMES,
    "places": "SELECT count(*), md5(string_agg(properties::text, ',' ORDER BY id))"
    ' FROM semantic_map."Place"',
    "edges": 'SELECT count(*) FROM semantic_map."ADJACENT_TO"',
    "paths": "SELECT * FROM cypher('semantic_map', $$ MATCH (k:Keyframe)-[:IN_PLACE]->(p:Place)"
    " WHERE k.run_id = 'robot-0' RETURN count(DISTINCT p.place_id) $$) AS (n agtype)",
    "vector": "SELECT count(*) FROM detection_embeddings WHERE det_pk < 1000",
}
PAUSE_S = 0.02


def corrections(server: EmbeddedServer, folder: Path, quick: bool) -> None:
    """Seconds until a name is in the graph; a refold's time as a ratio to a plain rebuild's."""
    size = KEYFRAMES // 10 if quick else KEYFRAMES
    log = folder / f"log-corrections-{size}"
    shutil.rmtree(log, ignore_errors=True)  # an earlier run has given its commands
    make_log(log, size)
    targets = Targets(server.url, server.url)
    plain, cpu = time.perf_counter(), time.process_time()
    rebuild(log, targets, Settings(), hnsw=False)
    plain, cpu = time.perf_counter() - plain, time.process_time() - cpu
    progress, stop = TailProgress(), threading.Event()
    following = threading.Thread(
        target=tail,
        args=(log, targets, Settings()),
        kwargs={"stop": stop, "progress": progress},
    )
    following.start()
    try:
        with LogReader(log) as reader:
            _follow_from_start(log, reader.next_offset, progress)
        with connect_for_cypher(server.url) as asking, _Readers(server.url) as readers:
            unnamed = readers.answers_now(asking)
            given = time.perf_counter()
            _give(log, NamePlace(**_who("name"), place=_anchor(0), name="kitchen"))
            while str(asking.execute(NAMES).fetchone()) == unnamed["names"]:
                assert following.is_alive(), "the tail has ended"
                assert time.perf_counter() - given < WAIT_S, "the name has not come"
                time.sleep(PAUSE_S)
            named = time.perf_counter() - given
            before = readers.answers_now(asking)
            given, own = time.perf_counter(), time.process_time()
            pair = (_anchor(0), _anchor(size // 2))
            at = _give(log, KeepApart(**_who("apart"), places=pair))
            assert progress.wait(at + 1, WAIT_S)  # type: ignore[arg-type]
            refold, own = time.perf_counter() - given, time.process_time() - own
            after = readers.answers_now(asking)
        failed, wrong, answers = readers.tally([unnamed, before, after])
    finally:
        stop.set()
        following.join()
    print(
        f"corrections of {size} keyframes: a name is in the graph after {named:.2f} s; refold"
        f" {refold:.1f} s (own CPU {own:.1f} s), plain rebuild {plain:.1f} s (own CPU {cpu:.1f} s):"
        f" ratio {refold / plain:.2f} (CPU {own / cpu:.2f}); {answers} reads meanwhile,"
        f" {failed} failed, {wrong} wrong"
    )


def _follow_from_start(log: Path, end: int, progress: TailProgress) -> None:
    """Wait until the tail has folded what it goes on from: it writes the next event then."""
    at = _give(log, NamePlace(**_who("first"), place=_anchor(1_000_000_000), name="nowhere"))
    assert at == end
    assert progress.wait(at + 1, WAIT_S)  # type: ignore[arg-type]


def _who(command_id: str) -> dict[str, Any]:
    return {"command_id": f"{command_id}-{time.time_ns()}", "issued_by": "bench"}


def _anchor(keyframe_id: int) -> Anchor:
    return Anchor(run_id=f"robot-{keyframe_id // 2000}", keyframe_id=keyframe_id)  # type: ignore[arg-type]


def _give(log: Path, command: Command) -> int:
    with LogWriter(log, fsync=parse_fsync("50ms")) as writer:
        return int(writer.append(COMMAND_KEY, encode_command(command)))


class _Readers:
    """A process that asks all queries in turn, until the end of the block."""

    def __init__(self, url: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._stop, self._queue = context.Event(), context.Queue()
        self._process = context.Process(target=_ask, args=(url, self._stop, self._queue))
        self._answers: dict[str, Counter[str]] = {}
        self._failed = 0

    def __enter__(self) -> "_Readers":
        self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._answers, self._failed = self._queue.get()
        self._process.join()

    def answers_now(self, asking: psycopg.Connection) -> dict[str, str]:
        """What each query answers now."""
        return {name: str(asking.execute(query).fetchone()) for name, query in QUERIES.items()}  # type: ignore[arg-type]

    def tally(self, allowed: list[dict[str, str]]) -> tuple[int, int, int]:
        """Failed reads, reads that no map of ``allowed`` gives, and all reads."""
        wrong = sum(
            count
            for name, answers in self._answers.items()
            for answer, count in answers.items()
            if answer not in {answers_then[name] for answers_then in allowed}
        )
        return self._failed, wrong, sum(sum(c.values()) for c in self._answers.values())


def _ask(url: str, stop: Event, queue: Any) -> None:
    answers: dict[str, Counter[str]] = {name: Counter() for name in QUERIES}
    failed = 0
    connection = connect_for_cypher(url)
    while not stop.is_set():
        for name, query in QUERIES.items():
            try:
                answers[name][str(connection.execute(query).fetchone())] += 1  # type: ignore[arg-type]
            except psycopg.Error:
                failed += 1
                connection.close()
                connection = connect_for_cypher(url)
        stop.wait(PAUSE_S)
    connection.close()
    queue.put((answers, failed))
