"""Replay and tail make the same rows, and they are what the fold says."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psycopg
import pytest
from pgvector.psycopg import register_vector

from eventsrc.log import LogReader
from projections.fold.map_errors import DatabaseError, FoldError, ProjectionMismatch
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.view import MapView
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.vector_sink import build_hnsw
from tests.support.envelopes import detection, envelope
from tests.support.logs import WEIRD, append_raw, bridge, walk, write_log
from tests.support.rows import (
    all_rows,
    expected_graph,
    graph_rows,
    parsed,
    vector_rows,
    wait_for_drops,
)
from tests.support.thorough import mostly_slow, rounds

SETTINGS = Settings()
PROJECTIONS = Path(__file__).parents[2] / "docs/projections.md"


def log_in(folder: Path) -> Path:
    """Two runs with merges, duplicates, noise, odd names, keyframes without pose."""
    documents = walk(120) + walk(60, run_id="x'}) DETACH DELETE r //", seed=2)
    documents += walk(5) + list(bridge()) + walk(40, run_id="run-c", seed=3)
    return write_log(folder / "log", documents)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return log_in(tmp_path)


@pytest.fixture(scope="module")
def replayed_log(tmp_path_factory: pytest.TempPathFactory, module_database: Targets) -> Path:
    """The log whose map ``module_database`` has, for tests that only read."""
    log = log_in(tmp_path_factory.mktemp("replayed"))
    rebuild(log, module_database, SETTINGS)
    return log


@pytest.fixture
def replayed(replayed_log: Path, module_database: Targets) -> Iterator[psycopg.Connection]:
    """A session of a user who asks what has been replayed."""
    with psycopg.connect(module_database.graph_url, autocommit=True) as connection:
        connection.execute("LOAD 'age'")
        connection.execute('SET search_path = ag_catalog, "$user", public')
        yield connection


def view_of(log: Path, until: int | None = None, settings: Settings = SETTINGS) -> MapView:
    with LogReader(log) as reader:
        return fold_log(reader, settings, until)[1]


def test_replay_writes_what_the_fold_says(log: Path, one_database: Targets) -> None:
    report = rebuild(log, one_database, SETTINGS)
    view = view_of(log)
    assert view.counts()["places"] >= 1
    assert view.counts()["ADJACENT_TO"] + view.counts()["LOCATED_IN"] > 0
    found = parsed(graph_rows(one_database.graph_url))
    expected = expected_graph(view)
    assert found == expected
    # As text, because to Python 1 == 1.0 and 0.0 == -0.0, which to a graph they are not.
    assert json.dumps(found, sort_keys=True) == json.dumps(expected, sort_keys=True)
    assert report.digest == map_digest(view)
    assert report.events == view.next_offset


@pytest.mark.parametrize("kind", mostly_slow(["two_databases", "one_database"]))
def test_tail_writes_the_rows_of_replay(
    log: Path, kind: str, request: pytest.FixtureRequest
) -> None:
    targets: Targets = request.getfixturevalue(kind)
    report = tail(log, targets, SETTINGS, once=True)
    assert report.next_offset == view_of(log).next_offset
    tailed = all_rows(targets)
    rebuild(log, targets, SETTINGS)
    assert all_rows(targets) == tailed
    assert parsed(dict(tailed[0])) == expected_graph(view_of(log))


@pytest.mark.slow
def test_tail_in_small_steps_through_merges(tmp_path: Path, one_database: Targets) -> None:
    path = tmp_path / "log"
    for documents in (walk(50), list(bridge())[:7], list(bridge())[7:], walk(30, first=50)):
        for start in range(0, len(documents), 9):
            write_log(path, documents[start : start + 9])
            tail(path, one_database, SETTINGS, once=True)
        assert parsed(graph_rows(one_database.graph_url)) == expected_graph(view_of(path))
    stepped = all_rows(one_database)
    rebuild(path, one_database, SETTINGS)
    assert all_rows(one_database) == stepped


@pytest.mark.slow
def test_a_second_replay_and_tail_change_nothing(log: Path, one_database: Targets) -> None:
    first = rebuild(log, one_database, SETTINGS)
    rows = all_rows(one_database)
    assert rebuild(log, one_database, SETTINGS).digest == first.digest
    assert all_rows(one_database) == rows
    assert tail(log, one_database, SETTINGS, once=True).events == 0
    assert all_rows(one_database) == rows


def test_replay_until_is_the_earlier_map_and_tail_goes_on(log: Path, one_database: Targets) -> None:
    rebuild(log, one_database, SETTINGS, until=100)
    assert parsed(graph_rows(one_database.graph_url)) == expected_graph(view_of(log, 100))
    report = tail(log, one_database, SETTINGS, once=True)
    assert report.events == view_of(log).next_offset - 100
    assert parsed(graph_rows(one_database.graph_url)) == expected_graph(view_of(log))


def test_each_sink_alone_has_its_own_checkpoint(log: Path, two_databases: Targets) -> None:
    rebuild(log, two_databases, SETTINGS, only="graph", until=50)
    rebuild(log, two_databases, SETTINGS, only="vectors", until=80)
    report = tail(log, two_databases, SETTINGS, once=True)
    assert report.next_offset == view_of(log).next_offset
    apart = all_rows(two_databases)
    rebuild(log, two_databases, SETTINGS)
    assert all_rows(two_databases) == apart


def test_the_table_has_the_columns_of_the_design(
    replayed_log: Path, module_database: Targets, replayed: psycopg.Connection
) -> None:
    view = view_of(replayed_log)
    columns = replayed.execute(
        "SELECT attname::text, format_type(atttypid, atttypmod) FROM pg_attribute"
        " WHERE attrelid = 'detection_embeddings'::regclass AND attnum > 0 ORDER BY attnum"
    ).fetchall()
    assert dict(columns)["embedding"] == "vector(8)"
    assert dict(columns)["bbox"] == "real[]"
    assert [name for name, _ in columns] == [
        "det_pk", "run_id", "det_id", "keyframe_id", "class_name", "confidence", "bbox", "map_x",
        "map_y", "map_yaw", "camera", "embedding_model", "embedding", "ingested_at",
    ]  # fmt: skip
    searchable = [o for o in view.observations if o.embedding_crc is not None]
    rows = vector_rows(module_database.vector_url)
    assert [row[0] for row in rows] == [o.ordinal + 1 for o in searchable]
    assert [row[2] for row in rows] == [o.det_id for o in searchable]
    assert {row[4] for row in rows} == set(WEIRD)
    with LogReader(replayed_log) as reader:
        logged = {e.offset: e.logged_ns for e in reader.read()}
    for row, observation in zip(rows, searchable, strict=True):
        offset = view.keyframes[observation.keyframe].offset
        assert round(row[-1].timestamp() * 1_000_000) == logged[offset] // 1000


def test_both_queries_of_the_design_work_verbatim(
    replayed_log: Path, replayed: psycopg.Connection
) -> None:
    view = view_of(replayed_log)
    target = next(o for o in view.observations if o.object is not None)
    row = replayed.execute(
        "SELECT embedding::text FROM detection_embeddings WHERE det_id = %s", [target.det_id]
    ).fetchone()
    assert row is not None
    nearest = replayed.execute(
        "SELECT det_id, embedding <=> %s AS distance"
        " FROM detection_embeddings ORDER BY distance LIMIT 10",
        row,
    ).fetchall()
    assert nearest[0][0] == target.det_id
    assert nearest[0][1] == pytest.approx(0.0, abs=1e-6)
    assert len(nearest) == 10
    for observation in [o for o in view.observations if o.object is not None][:40]:
        assert observation.object is not None
        found = replayed.execute(
            "SELECT * FROM cypher('semantic_map', $q$"
            " MATCH (obs:Observation {det_id: '" + observation.det_id.replace("'", "\\'") + "'})"
            "-[:OBSERVES]->(obj:Object)-[:LOCATED_IN]->(p:Place)"
            " RETURN p.place_id, p.centroid_x, p.centroid_y, obj.class_name"
            " $q$) AS (place_id agtype, x agtype, y agtype, class_name agtype)"
        ).fetchall()
        landmark = view.objects[observation.object]
        expected = []
        if landmark.place is not None:
            place = view.places[landmark.place]
            expected = [(place.place_id, place.centroid_x, place.centroid_y, landmark.class_name)]
        assert [tuple(json.loads(value) for value in r) for r in found] == expected


def test_a_search_with_conditions_as_documented_finds_what_is_nearest(
    tmp_path: Path, one_database: Targets
) -> None:
    documented = next(line for line in PROJECTIONS.read_text().splitlines() if "= $class" in line)
    search = documented.replace("$query", "%(query)s").replace("= $class", "= ANY(%(classes)s)")
    rebuild(write_log(tmp_path / "log", walk(300)), one_database, SETTINGS)
    chance = np.random.default_rng(1)
    with psycopg.connect(one_database.vector_url, autocommit=True) as connection:
        register_vector(connection)
        assert build_hnsw(connection, threshold=1).built
        connection.execute("SET enable_seqscan = off")  # where an index can be used, it is
        rows = connection.execute(
            "SELECT det_id, class_name, embedding::real[] FROM detection_embeddings"
        ).fetchall()
        vectors = np.array([row[2] for row in rows])
        names = sorted({row[1] for row in rows})
        assert len(names) > 2
        for _ in range(rounds(1000, 50)):
            classes = list(chance.choice(names, int(chance.integers(1, 3)), replace=False))
            query = chance.normal(size=vectors.shape[1]).astype(np.float32)
            found = connection.execute(search, {"query": query, "classes": classes}).fetchall()
            away = 1.0 - vectors @ query / np.linalg.norm(query)
            fitting = [n for n, row in enumerate(rows) if row[1] in classes]
            best = sorted(fitting, key=lambda n: away[n])[:10]
            assert [each for (each,) in found] == [rows[n][0] for n in best]


def test_the_documented_search_goes_through_the_index(
    tmp_path: Path, one_database: Targets
) -> None:
    page = PROJECTIONS.read_text()
    start = page.index("SELECT det_id, embedding <=> $query AS distance FROM (")
    rebuild(write_log(tmp_path / "log", walk(300)), one_database, SETTINGS)
    with psycopg.connect(one_database.vector_url, autocommit=True) as connection:
        register_vector(connection)
        assert build_hnsw(connection, threshold=1).built
        connection.execute("SET enable_seqscan = off")
        rows = connection.execute(
            "SELECT det_id, embedding::real[] FROM detection_embeddings"
        ).fetchall()
        vectors = np.array([row[1] for row in rows])
        search = page[start : page.index(";", start)].replace("$query", "%(query)s")
        search = search.replace("halfvec(512)", f"halfvec({vectors.shape[1]})")
        query = np.random.default_rng(1).normal(size=vectors.shape[1]).astype(np.float32)
        plan = connection.execute(f"EXPLAIN {search}", {"query": query}).fetchall()
        assert "detection_embeddings_halves" in str(plan)
        found = connection.execute(search, {"query": query}).fetchall()
        best = np.argsort(-(vectors @ query))[:10]
        assert [det_id for det_id, _ in found] == [rows[n][0] for n in best]


@pytest.mark.slow
def test_the_dimension_follows_the_map(tmp_path: Path, one_database: Targets) -> None:
    empty = write_log(tmp_path / "log", [envelope(0)])
    tail(empty, one_database, SETTINGS, once=True)
    write_log(empty, walk(30, first=1, dim=16))
    tail(empty, one_database, SETTINGS, once=True)
    tailed = all_rows(one_database)
    assert tailed[1]
    rebuild(empty, one_database, SETTINGS)
    assert all_rows(one_database) == tailed


def test_wide_embeddings(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(5, dim=4096))
    rebuild(log, one_database, SETTINGS)
    searchable = [o for o in view_of(log).observations if o.embedding_crc is not None]
    assert [row[2] for row in vector_rows(one_database.vector_url)] == [
        o.det_id for o in searchable
    ]


def test_no_part_of_a_row_that_fits_a_page_is_stored_apart(
    tmp_path: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    rebuild(write_log(tmp_path / "log", walk(5, dim=512)), one_database, SETTINGS)
    assert vector_rows(one_database.vector_url)
    row = pg.execute(
        "SELECT pg_relation_size(reltoastrelid) FROM pg_class"
        " WHERE oid = 'public.detection_embeddings'::regclass"
    ).fetchone()
    assert row == (0,)


def test_a_row_that_is_larger_than_a_page(tmp_path: Path, one_database: Targets) -> None:
    name = "".join(hashlib.sha256(bytes([i])).hexdigest() for i in range(4))
    seen = detection(name, [1.0] * 1900, det_id=name, embedding_model=name)
    log = write_log(tmp_path / "log", [envelope(0, run_id=name, detections=[seen])])
    rebuild(log, one_database, SETTINGS)
    rows = vector_rows(one_database.vector_url)
    assert [(row[1], row[2], row[4], row[11]) for row in rows] == [(name,) * 4]


@pytest.mark.slow
def test_a_box_beyond_float32(tmp_path: Path, one_database: Targets) -> None:
    boxes = ([1e300, -1e300, 1e-60, 0.1], [0.1, 0.2, 0.3, 16777217.0])
    seen = [detection("cup", [1.0, float(i)], bbox=box) for i, box in enumerate(boxes)]
    log = write_log(tmp_path / "log", [envelope(0, detections=seen)])
    tail(log, one_database, SETTINGS, once=True)
    inserted = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    copied = all_rows(one_database)
    assert inserted == copied
    assert copied[1][0][6][:3] == [float("inf"), float("-inf"), 0.0]


@pytest.mark.slow
def test_other_settings_are_refused_with_the_difference(log: Path, one_database: Targets) -> None:
    rebuild(log, one_database, SETTINGS)
    rows = all_rows(one_database)
    other = SETTINGS.with_assignments(["eps_m=1.0"])
    with pytest.raises(ProjectionMismatch, match=r"eps_m=1.5 there, 1.0 here.*mapfold replay"):
        tail(log, one_database, other, once=True)
    assert all_rows(one_database) == rows
    rebuild(log, one_database, other)
    assert tail(log, one_database, other, once=True).events == 0


def test_another_log_is_refused(
    replayed_log: Path, tmp_path: Path, module_database: Targets
) -> None:
    other = write_log(tmp_path / "other", walk(200))
    with pytest.raises(ProjectionMismatch, match=r"made from log .* mapfold replay"):
        tail(other, module_database, SETTINGS, once=True)


def test_a_log_that_was_cut_or_continued_differently_is_refused(
    tmp_path: Path, one_database: Targets
) -> None:
    long = write_log(tmp_path / "log", walk(30))
    rebuild(long, one_database, SETTINGS)
    with psycopg.connect(one_database.graph_url) as connection:
        connection.execute("UPDATE mapfold.checkpoint SET next_offset = 31")
    with pytest.raises(ProjectionMismatch, match=r"31 events are in the graph .* only 30"):
        tail(long, one_database, SETTINGS, once=True)
    with psycopg.connect(one_database.graph_url) as connection:
        connection.execute("UPDATE mapfold.checkpoint SET next_offset = 29")
    with pytest.raises(ProjectionMismatch, match="offset 28 is not the one"):
        tail(long, one_database, SETTINGS, once=True)


def test_a_users_own_tables_and_graphs_stay(
    log: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    pg.execute("CREATE TABLE public.mine AS SELECT 1 AS n")
    pg.execute("SELECT create_graph('my_graph'), create_vlabel('my_graph', 'Run')")
    for _ in range(2):
        rebuild(log, one_database, SETTINGS)
    assert pg.execute("SELECT n FROM public.mine").fetchone() == (1,)
    wait_for_drops(one_database)
    names = pg.execute("SELECT name::text FROM ag_graph ORDER BY 1").fetchall()
    assert names == [("my_graph",), ("semantic_map",)]


@pytest.mark.parametrize(
    ("statement", "told"),
    mostly_slow(
        [
            ("CREATE SCHEMA semantic_map", "schema semantic_map that mapfold did not make"),
            ("CREATE TABLE public.detection_embeddings (n int)", "table detection_embeddings that"),
            ("CREATE SCHEMA mapfold", "schema mapfold that mapfold did not make"),
        ]
    ),
)
def test_foreign_objects_under_our_names_are_refused(
    log: Path, one_database: Targets, pg: psycopg.Connection, statement: str, told: str
) -> None:
    pg.execute(statement)  # type: ignore[arg-type]
    for act in (
        lambda: rebuild(log, one_database, SETTINGS),
        lambda: tail(log, one_database, SETTINGS, once=True),
    ):
        with pytest.raises(DatabaseError, match=told):
            act()


@pytest.mark.slow
def test_a_view_on_the_table_stops_the_swap(
    log: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    rebuild(log, one_database, SETTINGS)
    rows = all_rows(one_database)
    pg.execute("CREATE VIEW public.recent AS SELECT det_id FROM detection_embeddings")
    with pytest.raises(DatabaseError, match="something else depends on detection_embeddings"):
        rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == rows


def test_an_event_that_cannot_be_folded(log: Path, one_database: Targets) -> None:
    before = view_of(log)
    append_raw(log, b'{"run_id": "run-z", "keyframe_id": "seven"}')
    write_log(log, walk(10, run_id="run-d"))
    with pytest.raises(FoldError, match=f"offset {before.next_offset} "):
        rebuild(log, one_database, SETTINGS)
    report = tail(log, one_database, SETTINGS, once=True)
    assert [(d.offset, d.run_id) for d in report.parked] == [(before.next_offset, "run-z")]
    assert report.next_offset == before.next_offset + 11
    rows = all_rows(one_database)
    again = tail(log, one_database, SETTINGS, once=True)
    assert (again.events, again.parked) == (0, [])
    assert all_rows(one_database) == rows
    with psycopg.connect(one_database.graph_url) as connection:
        kept = connection.execute(
            "SELECT sink, log_offset, reason FROM mapfold.dead_letter ORDER BY 1"
        ).fetchall()
    assert [(k[0], k[1]) for k in kept] == [
        ("graph", before.next_offset),
        ("vectors", before.next_offset),
    ]
    assert "keyframe_id" in kept[0][2]


@pytest.mark.parametrize("batch_events", mostly_slow([1, 200]), ids=["pipelined", "plain"])
def test_a_row_the_database_refuses_ends_the_tail_with_a_message(
    tmp_path: Path, one_database: Targets, pg: psycopg.Connection, batch_events: int
) -> None:
    """It is no lost connection, so nothing is tried again; the checkpoint stays."""
    log = write_log(tmp_path / "log", walk(40))
    rebuild(log, one_database, SETTINGS, until=30)
    pg.execute(
        'INSERT INTO semantic_map."Keyframe" (id, properties) VALUES (_graphid(4, 31), %s)', ["{}"]
    )
    with pytest.raises(DatabaseError, match="duplicate key value"):
        tail(log, one_database, SETTINGS, once=True, batch_events=batch_events)
    assert pg.execute("SELECT min(next_offset) FROM mapfold.checkpoint").fetchone() == (30,)
