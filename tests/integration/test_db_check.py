"""`db check` finds every kind of damage, names it, and `--repair` undoes it."""

import sys
from pathlib import Path

import psycopg
import pytest
from psycopg import sql

from eventsrc.base.progress import send_progress_to
from projections.fold.map_errors import DatabaseError, ProjectionMismatch, ProjectionMissing
from projections.fold.settings import Settings
from projections.postgres import checkpoints, rebuild, tail
from projections.postgres.check import NAMED, check
from projections.postgres.connection import Connection, Targets
from projections.postgres.labels import SinkName
from projections.postgres.sink import Checkpoint
from projections.postgres.status import projection_status
from tests.support.commands import Commands
from tests.support.logs import append_raw, bridge, walk, write_log
from tests.support.thorough import every_other, mostly_slow

SETTINGS = Settings()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", walk(80) + list(bridge()) + walk(20, first=80, seed=4))


def test_a_sound_projection(log: Path, two_databases: Targets) -> None:
    rebuild(log, two_databases, SETTINGS, only="vectors", until=90)
    rebuild(log, two_databases, SETTINGS, only="graph")
    stages: set[str] = set()
    send_progress_to(lambda stage, *_: stages.add(stage))
    graph, vectors = check(log, two_databases, SETTINGS)
    send_progress_to(None)
    assert stages == {"reading the log"}
    assert (graph.sink, graph.differing, graph.next_offset) == ("graph", 0, 120)
    assert (vectors.sink, vectors.differing, vectors.next_offset) == ("vectors", 0, 90)
    assert graph.rows > 500
    assert vectors.rows > 30


def test_a_parked_event_is_no_difference(log: Path, one_database: Targets) -> None:
    append_raw(log, b"not an envelope")
    write_log(log, walk(10, run_id="after"))
    assert tail(log, one_database, SETTINGS, once=True).parked
    assert [r.differing for r in check(log, one_database, SETTINGS)] == [0, 0]


DAMAGE = {
    "a vertex gone": (
        (
            'DELETE FROM semantic_map."Observation" WHERE id = (SELECT max(id::text)::graphid'
            ' FROM semantic_map."Observation")'
        ),
        [("Observation", "missing")],
    ),
    "an edge too many": (
        (
            'INSERT INTO semantic_map."ADJACENT_TO" (id, start_id, end_id, properties)'
            " SELECT _graphid(15, 99), id, id, '{}' FROM semantic_map.\"Place\" LIMIT 1"
        ),
        [("ADJACENT_TO", "extra")],
    ),
    "an int where a float was": (
        (
            'UPDATE semantic_map."Run" SET properties = \'{"run_id": "run-a", "started_at":'
            " 1774357200}' WHERE id = _graphid(3, 1)"
        ),
        [("Run", "different")],
    ),
    "an edge to another end": (
        (
            'UPDATE semantic_map."OBSERVES" SET end_id = start_id WHERE id = (SELECT max(id::text)'
            '::graphid FROM semantic_map."OBSERVES")'
        ),
        [("OBSERVES", "different")],
    ),
    "a vector changed": (
        "UPDATE detection_embeddings SET embedding = '[1,0,0,0,0,0,0,0]' WHERE det_pk = 1",
        [("detection_embeddings", "different")],
    ),
    "one bit of a vector changed": (
        (
            "UPDATE detection_embeddings SET embedding = (SELECT array_agg(CASE n WHEN 3 THEN v +"
            " sign(v) * 1e-7 ELSE v END ORDER BY n)::vector FROM unnest(embedding::real[]) WITH"
            " ORDINALITY AS e(v, n)) WHERE det_pk = 1"
        ),
        [("detection_embeddings", "different")],
    ),
    "a name changed": (
        "UPDATE detection_embeddings SET class_name = class_name || ' ' WHERE det_pk = 1",
        [("detection_embeddings", "different")],
    ),
}


def test_every_kind_of_damage_is_named_and_repaired(
    log: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    rebuild(log, one_database, SETTINGS)
    for damage in every_other(DAMAGE):
        statement, expected = DAMAGE[damage]
        assert pg.execute(statement).rowcount == 1, damage  # type: ignore[arg-type]
        reports = check(log, one_database, SETTINGS)
        found = [(d.table, d.kind) for report in reports for d in report.differences]
        assert found == expected, damage
        for report in reports:
            if report.differing:
                rebuild(log, one_database, SETTINGS, until=report.next_offset, only=report.sink)
    assert [r.differing for r in check(log, one_database, SETTINGS)] == [0, 0]


def test_a_count_on_an_edge(tmp_path: Path, one_database: Targets, pg: psycopg.Connection) -> None:
    log = write_log(tmp_path / "log", walk(120))
    rebuild(log, one_database, SETTINGS)
    changed = pg.execute(
        'UPDATE semantic_map."ADJACENT_TO" SET properties = \'{"shared_transitions": 999}\''
        ' WHERE id = (SELECT max(id::text)::graphid FROM semantic_map."ADJACENT_TO")'
    )
    assert changed.rowcount == 1
    (graph,) = check(log, one_database, SETTINGS, only="graph")
    (difference,) = graph.differences
    assert (difference.table, difference.kind) == ("ADJACENT_TO", "different")
    assert "999" in str(difference.found)


def test_all_differences_are_counted_though_not_all_are_named(
    log: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    rebuild(log, one_database, SETTINGS)
    gone = pg.execute('DELETE FROM semantic_map."HAS_KEYFRAME"').rowcount
    (graph,) = check(log, one_database, SETTINGS, only="graph")
    assert graph.differing == gone > NAMED
    assert len(graph.differences) == NAMED


def test_what_cannot_be_compared_is_refused(
    log: Path, tmp_path: Path, one_database: Targets
) -> None:
    with pytest.raises(ProjectionMissing, match="mapfold replay"):
        check(log, one_database, SETTINGS)
    rebuild(log, one_database, SETTINGS)
    with pytest.raises(ProjectionMismatch, match="min_samples=3 there, 2 here"):
        check(log, one_database, SETTINGS.with_assignments(["min_samples=2"]))
    with psycopg.connect(one_database.graph_url) as connection:
        connection.execute("UPDATE mapfold.checkpoint SET next_offset = 130")
    with pytest.raises(ProjectionMismatch, match=r"130 events are in the graph .* only 120"):
        check(log, one_database, SETTINGS)
    with psycopg.connect(one_database.graph_url) as connection:
        connection.execute("UPDATE mapfold.checkpoint SET next_offset = 119")
    with pytest.raises(ProjectionMismatch, match="offset 118 is not the one"):
        check(log, one_database, SETTINGS)


DROPS = {
    "graph": "SELECT drop_graph('semantic_map', true)",
    "vectors": "DROP TABLE detection_embeddings",
}


@pytest.mark.parametrize("sink", mostly_slow(DROPS))
def test_dropped_tables_are_reported_and_not_written_to(
    log: Path, one_database: Targets, pg: psycopg.Connection, sink: str
) -> None:
    rebuild(log, one_database, SETTINGS)
    pg.execute(DROPS[sink])  # type: ignore[arg-type]
    found = {s.sink: s for s in projection_status(log, one_database, SETTINGS).sinks}
    assert found[sink].condition == "missing"
    assert "mapfold replay" in str(found[sink].note)
    write_log(log, walk(5, first=100))
    message = f"the checkpoint of the {sink} has 120 events, but .* dropped; .* mapfold replay"
    for act in (
        lambda: check(log, one_database, SETTINGS),
        lambda: tail(log, one_database, SETTINGS, once=True),
    ):
        with pytest.raises(ProjectionMissing, match=message):
            act()
    rebuild(log, one_database, SETTINGS)
    assert [r.differing for r in check(log, one_database, SETTINGS)] == [0, 0]


@pytest.mark.parametrize("sink", mostly_slow(DROPS))
@pytest.mark.slow
def test_a_rebuild_beside_a_check_makes_no_difference(
    log: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch, sink: SinkName
) -> None:
    """To the check's snapshot the tables of such a rebuild would be empty."""
    monkeypatch.setattr(sys.modules["projections.postgres.shadows"], "LOCK_TIMEOUT_S", 0.3)
    rebuild(log, one_database, SETTINGS)
    load = checkpoints.load

    def rebuild_meanwhile(connection: Connection, sink: SinkName) -> Checkpoint | None:
        found = load(connection, sink)
        monkeypatch.setattr(checkpoints, "load", load)
        with pytest.raises(DatabaseError, match="readers kept the map locked"):
            rebuild(log, one_database, SETTINGS)
        return found

    monkeypatch.setattr(checkpoints, "load", rebuild_meanwhile)
    assert [r.differing for r in check(log, one_database, SETTINGS, only=sink)] == [0]


def door(pg: psycopg.Connection) -> None:
    """What a user might write into the tables of the map."""
    pg.execute(
        "SELECT * FROM cypher('semantic_map', $$ CREATE (:Door)-[:HINGE]->(:Door) RETURN 1 $$)"
        " AS (n agtype)"
    )
    pg.execute('CREATE TABLE semantic_map."a table" AS SELECT 7 AS n')
    pg.execute('CREATE VIEW semantic_map."a ""view""" AS SELECT 7 AS n')
    pg.execute(
        "INSERT INTO semantic_map._ag_label_vertex (id, properties) VALUES (_graphid(1, 1), '{}')"
    )


FOREIGN = {
    "Door": ("vertex label", 2),
    "HINGE": ("edge label", 1),
    "_ag_label_vertex": ("vertices without a label", 1),
    'a "view"': ("view", 1),
    "a table": ("table", 1),
}


def test_foreign_tables_are_found_and_copied_and_removed_by_the_sql_given(
    log: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    rebuild(log, one_database, SETTINGS)
    door(pg)
    graph, vectors = check(log, one_database, SETTINGS)
    assert {t.table: (t.what, t.rows) for t in graph.foreign} == FOREIGN
    assert (graph.differing, graph.sound, vectors.sound) == (0, False, True)
    with psycopg.connect(one_database.graph_url) as anyone:
        for table in graph.foreign:
            anyone.execute(table.keep)  # type: ignore[arg-type]
            anyone.execute(table.remove)  # type: ignore[arg-type]
    assert all(report.sound for report in check(log, one_database, SETTINGS))
    for table in FOREIGN:
        count = sql.SQL("SELECT count(*) FROM {}").format(sql.Identifier("public", table))
        assert pg.execute(count).fetchone() == (FOREIGN[table][1],)


@pytest.mark.slow
def test_the_command_names_foreign_tables_and_repair_does_not_drop_them(
    log: Path, one_database: Targets, pg: psycopg.Connection
) -> None:
    mapfold = Commands.in_folder(log.parent)
    rebuild(log, one_database, SETTINGS)
    door(pg)
    pg.execute('CREATE TABLE semantic_map."red \x1b[31m" ()')
    pg.execute('DELETE FROM semantic_map."HAS_KEYFRAME"')
    said = mapfold("db", "check", "log", "--db", one_database.graph_url, "--repair", code=3)
    assert "not ours: vertex label 'Door' with 2 rows; a rebuild drops it" in said.out
    assert "SELECT ag_catalog.drop_label('semantic_map', 'Door')" in said.out
    assert "not rebuilt" in said.err
    assert "\x1b" not in said.out
    assert len(check(log, one_database, SETTINGS)[0].foreign) == len(FOREIGN) + 1
