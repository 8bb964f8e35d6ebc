"""Readers run the two queries of docs/projections.md in a loop while maps are rebuilt."""

import sys
import threading
from collections.abc import Callable
from itertools import product
from pathlib import Path

import psycopg
import pytest

from projections.fold.map_errors import DatabaseError, ProjectionBusy
from projections.fold.settings import Settings
from projections.postgres import RebuildProgress, rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.cypher import connect_for_cypher
from projections.postgres.vector_sink import VectorShadow
from tests.support.logs import bridge, walk, write_log
from tests.support.rows import all_rows, wait_for_drops
from tests.support.thorough import THOROUGH, mostly_slow, rounds

SETTINGS = Settings()
WAIT_S = 60.0
REBUILDS = rounds(6, 2)
HALF = rounds(150, 60)
"""Keyframes of the smaller map, without its bridge of 20."""
PAUSE_S = 0.0 if THOROUGH else 0.01
"""Between two questions of a reader, so that a rebuild is not slowed down most of all."""

COUNT_PATHS = (
    "SELECT * FROM cypher('semantic_map', $$"
    " MATCH (o:Observation)-[:OBSERVES]->(b:Object)-[:LOCATED_IN]->(p:Place)"
    " RETURN count(*) $$) AS (n agtype)"
)
COUNT_LABELS = (
    "SELECT * FROM cypher('semantic_map', $$"
    " MATCH (r:Run)-[:HAS_KEYFRAME]->(k:Keyframe)-[:HAS_OBSERVATION]->(o:Observation)"
    " RETURN count(*) $$) AS (n agtype)"
)
COUNT_VECTORS = "SELECT count(*) FROM detection_embeddings"


class Reader(threading.Thread):
    """Runs a query until it is stopped; keeps every answer and every error."""

    def __init__(self, open_: Callable[[], psycopg.Connection], query: str, prepare: bool) -> None:
        super().__init__()
        self.open, self.query, self.prepare = open_, query, prepare
        self.answers: list[str] = []
        self.errors: list[Exception] = []
        self.stop = threading.Event()
        self.first = threading.Event()

    def run(self) -> None:
        with self.open() as connection:
            while not self.stop.is_set():
                try:
                    row = connection.execute(self.query, prepare=self.prepare).fetchone()  # type: ignore[arg-type]
                except psycopg.Error as error:
                    self.errors.append(error)
                    return
                finally:
                    self.first.set()
                assert row is not None
                self.answers.append(str(row[0]))
                self.stop.wait(PAUSE_S)


def single_answer(connection: psycopg.Connection, query: str) -> str:
    row = connection.execute(query).fetchone()  # type: ignore[arg-type]
    assert row is not None
    return str(row[0])


@pytest.mark.parametrize("prepare", mostly_slow([False, True]), ids=["plain", "prepared"])
def test_readers_see_one_map_or_the_other_and_never_an_error(
    tmp_path: Path, one_database: Targets, pg: psycopg.Connection, prepare: bool
) -> None:
    log = write_log(tmp_path / "log", walk(HALF, rooms=2) + list(bridge()) + walk(HALF, first=HALF))
    queries = (COUNT_PATHS, COUNT_LABELS, COUNT_VECTORS)
    allowed: dict[str, set[str]] = {query: set() for query in queries}
    for until in (HALF + 20, None):
        rebuild(log, one_database, SETTINGS, until=until)
        for query in queries:
            allowed[query].add(single_answer(pg, query))
    assert all(len(answers) == 2 for answers in allowed.values())

    url = one_database.graph_url
    readers = [Reader(lambda: connect_for_cypher(url), query, prepare) for query in queries]
    for reader in readers:
        reader.start()
    try:
        for reader in readers:
            assert reader.first.wait(WAIT_S)
        for n in range(REBUILDS):
            rebuild(log, one_database, SETTINGS, until=HALF + 20 if n % 2 == 0 else None)
    finally:
        for reader in readers:
            reader.stop.set()
            reader.join(WAIT_S)
    for reader in readers:
        assert reader.errors == []
        assert set(reader.answers) <= allowed[reader.query]
        assert len(reader.answers) > REBUILDS
    wait_for_drops(one_database)
    names = pg.execute("SELECT name::text FROM ag_graph").fetchall()
    assert names == [("semantic_map",)]
    assert pg.execute("SELECT to_regnamespace('mapfold_old')").fetchone() == (None,)


def test_a_long_transaction_keeps_its_graph_and_the_next_rebuild_drops_it(
    tmp_path: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has read only the table so far; the graph it reads later must still be whole."""
    monkeypatch.setattr("projections.postgres.replaced_tables.WAIT_SECONDS", 0.2)
    log = write_log(tmp_path / "log", walk(60))
    rebuild(log, one_database, SETTINGS)
    with connect_for_cypher(one_database.graph_url) as reader:
        before = single_answer(reader, COUNT_PATHS)
        with reader.transaction():
            reader.execute("SELECT 1")
            rebuild(log, one_database, SETTINGS)
            assert single_answer(reader, COUNT_PATHS) == before
        graphs = reader.execute("SELECT name::text FROM ag_graph ORDER BY 1").fetchall()
        assert graphs == [("semantic_map",), ("semantic_map_old",)]
    rebuild(log, one_database, SETTINGS)
    wait_for_drops(one_database)
    with connect_for_cypher(one_database.graph_url) as reader:
        graphs = reader.execute("SELECT name::text FROM ag_graph").fetchall()
        assert graphs == [("semantic_map",)]


class Interrupted(Exception):
    """Simulates what ends a rebuild in the middle."""


@pytest.mark.parametrize(
    ("kind", "stage"),
    mostly_slow(
        [
            ("one_database", "writing"),
            ("two_databases", "tidying"),
            *product(["one_database"], ["folding", "swapping", "tidying", "indexing"]),
            *product(["two_databases"], ["folding", "writing", "swapping", "indexing"]),
        ],
        2,
    ),
)
def test_interrupted_at_each_stage_one_whole_map_is_served(
    tmp_path: Path, kind: str, stage: str, request: pytest.FixtureRequest
) -> None:
    targets: Targets = request.getfixturevalue(kind)
    log = write_log(tmp_path / "log", walk(100) + list(bridge()))
    rebuild(log, targets, SETTINGS, until=100)
    old = all_rows(targets)

    def interrupt(at: RebuildProgress) -> None:
        if at.stage == stage:
            raise Interrupted

    with pytest.raises(Interrupted):
        rebuild(log, targets, SETTINGS, progress=interrupt)
    found = all_rows(targets)
    rebuild(log, targets, SETTINGS)
    new = all_rows(targets)
    assert new != old
    assert found == (new if stage in ("tidying", "indexing") else old)
    assert tail(log, targets, SETTINGS, once=True).events == 0


def test_a_rebuild_refuses_to_run_beside_a_tail_and_the_other_way_round(
    tmp_path: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("projections.postgres.checkpoints.LOCK_GRACE_S", 0.0)
    log = write_log(tmp_path / "log", walk(30))
    refused = []

    def try_others(_: object) -> None:
        with pytest.raises(ProjectionBusy, match=r"\(mapfold (tail|replay); PostgreSQL"):
            rebuild(log, one_database, SETTINGS)
        with pytest.raises(ProjectionBusy, match="is writing the graph there"):
            tail(log, one_database, SETTINGS, once=True)
        with pytest.raises(ProjectionBusy, match="is writing the vectors there"):
            tail(log, one_database, SETTINGS, once=True, only="vectors")
        refused.append(True)

    tail(log, one_database, SETTINGS, once=True, on_batch=try_others)
    rebuild(
        log,
        one_database,
        SETTINGS,
        progress=lambda at: try_others(at) if at.stage == "writing" else None,
    )
    assert refused == [True, True]


@pytest.mark.slow
def test_the_two_sinks_may_be_written_at_the_same_time(
    tmp_path: Path, one_database: Targets
) -> None:
    log = write_log(tmp_path / "log", walk(30))

    def other(_: object) -> None:
        tail(log, one_database, SETTINGS, once=True, only="vectors")

    tail(log, one_database, SETTINGS, once=True, only="graph", on_batch=other)
    apart = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == apart


@pytest.mark.parametrize("query", mostly_slow([COUNT_PATHS, COUNT_LABELS, COUNT_VECTORS]))
def test_between_swap_and_commit_a_reader_waits_at_its_first_table(
    tmp_path: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch, query: str
) -> None:
    """So it resolves all its tables before the swap or all after, never some of each.

    The race itself is microseconds wide; that every table is locked when names move can be seen.
    """
    log = write_log(tmp_path / "log", walk(60))
    rebuild(log, one_database, SETTINGS, until=30)
    waited: list[str] = []

    def swap_then_read(self: VectorShadow, connection: psycopg.Connection) -> None:
        swap(self, connection)
        with connect_for_cypher(one_database.graph_url) as reader:
            reader.execute("SET lock_timeout = '50ms'")
            with pytest.raises(psycopg.errors.LockNotAvailable):
                reader.execute(query)  # type: ignore[arg-type]
            waited.append(query)

    swap = VectorShadow.swap_in
    monkeypatch.setattr(VectorShadow, "swap_in", swap_then_read)
    rebuild(log, one_database, SETTINGS)
    assert waited == [query]


def test_a_reader_that_keeps_its_lock_stops_the_swap_with_a_message(
    tmp_path: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules["projections.postgres.shadows"], "LOCK_TIMEOUT_S", 0.3)
    log = write_log(tmp_path / "log", walk(60))
    rebuild(log, one_database, SETTINGS, until=30)
    old = all_rows(one_database)
    with connect_for_cypher(one_database.graph_url) as reader, reader.transaction():
        reader.execute(COUNT_PATHS)
        with pytest.raises(DatabaseError, match="readers kept the map locked"):
            rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == old


@pytest.mark.parametrize(
    ("first", "second"),
    mostly_slow([(COUNT_VECTORS, COUNT_PATHS), (COUNT_PATHS, COUNT_VECTORS)]),
)
@pytest.mark.slow
def test_a_transaction_that_reads_both_is_never_ended_by_a_deadlock(
    tmp_path: Path, one_database: Targets, first: str, second: str
) -> None:
    log = write_log(tmp_path / "log", walk(60))
    rebuild(log, one_database, SETTINGS, until=30)
    swapping = threading.Event()

    def on_progress(at: RebuildProgress) -> None:
        if at.stage == "swapping":
            swapping.set()

    rebuilding = threading.Thread(
        target=rebuild, args=(log, one_database, SETTINGS), kwargs={"progress": on_progress}
    )
    with connect_for_cypher(one_database.graph_url) as reader:
        expected = single_answer(reader, first), single_answer(reader, second)
        with reader.transaction():
            answers = [single_answer(reader, first)]
            rebuilding.start()
            assert swapping.wait(WAIT_S)
            for _ in range(50):  # long enough to meet the rebuild's locks more than once
                answers.append(single_answer(reader, second))
                reader.execute("SELECT pg_sleep(0.02)")
        rebuilding.join(WAIT_S)
        assert not rebuilding.is_alive()
        assert answers == [expected[0], *[expected[1]] * 50]
        assert single_answer(reader, first) != expected[0]


@pytest.mark.slow
def test_readers_of_one_database_do_not_wait_for_those_of_the_other(
    tmp_path: Path, two_databases: Targets
) -> None:
    log = write_log(tmp_path / "log", walk(60))
    rebuild(log, two_databases, SETTINGS, until=30)
    swapping = threading.Event()

    def on_progress(at: RebuildProgress) -> None:
        if at.stage == "swapping":
            swapping.set()

    rebuilding = threading.Thread(
        target=rebuild, args=(log, two_databases, SETTINGS), kwargs={"progress": on_progress}
    )
    with (
        connect_for_cypher(two_databases.graph_url) as graph,
        psycopg.connect(two_databases.vector_url) as sits,
    ):
        expected = single_answer(graph, COUNT_PATHS)
        single_answer(sits, COUNT_VECTORS)
        rebuilding.start()
        assert swapping.wait(WAIT_S)
        graph.execute("SET lock_timeout = '900ms'")
        for _ in range(50):
            assert single_answer(graph, COUNT_PATHS) == expected
            graph.execute("SELECT pg_sleep(0.02)")
        assert rebuilding.is_alive()
        sits.rollback()
        rebuilding.join(WAIT_S)
    assert not rebuilding.is_alive()
    assert tail(log, two_databases, SETTINGS, once=True).events == 0


@pytest.mark.slow
def test_readers_that_end_one_by_one_never_end_a_waiting_one_by_a_deadlock(
    tmp_path: Path, one_database: Targets
) -> None:
    """The swap waits briefly for one, but for all of them longer than deadlock_timeout, 1 s."""
    log = write_log(tmp_path / "log", walk(60))
    rebuild(log, one_database, SETTINGS, until=30)
    swapping, url = threading.Event(), one_database.graph_url
    read, held = 'SELECT count(*) FROM semantic_map."{}"', threading.Semaphore(0)

    def sit(number: int, label: str) -> None:
        with psycopg.connect(url) as connection:
            single_answer(connection, read.format(label))
            held.release()
            assert swapping.wait(WAIT_S)
            connection.execute("SELECT pg_sleep(%s)", [0.15 * number])

    labels = ["Keyframe", "Pose", "Observation", "Object", "Place", "HAS_KEYFRAME"]
    sitting = [threading.Thread(target=sit, args=pair) for pair in enumerate(labels, 1)]
    rebuilding = threading.Thread(
        target=rebuild,
        args=(log, one_database, SETTINGS),
        kwargs={"progress": lambda at: swapping.set() if at.stage == "swapping" else None},
    )
    for thread in sitting:
        thread.start()
        assert held.acquire(timeout=WAIT_S)
    with psycopg.connect(url) as waiting:
        single_answer(waiting, read.format("ADJACENT_TO"))
        rebuilding.start()
        assert swapping.wait(WAIT_S)
        waiting.execute("SELECT pg_sleep(0.03)")
        single_answer(waiting, read.format("Run"))
    for thread in (*sitting, rebuilding):
        thread.join(WAIT_S)
        assert not thread.is_alive()
    assert tail(log, one_database, SETTINGS, once=True).events == 0
