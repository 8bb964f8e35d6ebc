"""The two least-privilege roles can do what docs/projections.md says and nothing else."""

from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import LogWriter
from projections.fold.map_errors import DatabaseError, ExtensionMissing
from projections.fold.settings import Settings
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets, connect, extension_version
from projections.postgres.cypher import connect_for_cypher, enforces_row_security
from projections.postgres.queries.candidate_search import CandidateReader
from projections.postgres.replaced_tables import roles_sql
from projections.postgres.status import projection_status
from tests.support.logs import bridge, walk, write_log
from tests.support.maps import drawn_map
from tests.support.rows import all_rows, map_rows, wait_for_drops
from tests.support.thorough import every_other, mostly_slow

pytestmark = pytest.mark.usefixtures("server_roles")

SETTINGS = Settings()
ROLES = ("a_reader", "a_writer", "mapfold_writer", "mapfold_reader")


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", walk(40))


@pytest.fixture
def projected(log: Path, one_database: Targets, pg: psycopg.Connection) -> Iterator[Targets]:
    """A projection whose owner has set up the roles, with a login in each."""
    rebuild(log, one_database, SETTINGS)
    pg.execute(roles_sql())  # type: ignore[arg-type]
    pg.execute(roles_sql())  # type: ignore[arg-type]  # twice does no harm
    pg.execute("CREATE ROLE a_reader LOGIN IN ROLE mapfold_reader")
    pg.execute("CREATE ROLE a_writer LOGIN IN ROLE mapfold_writer")
    yield one_database
    wait_for_drops(one_database)  # else it and DROP OWNED may each wait for the other
    for role in ROLES:
        pg.execute(f"DROP OWNED BY {role}")  # type: ignore[arg-type]
    for role in ROLES:
        pg.execute(f"DROP ROLE {role}")  # type: ignore[arg-type]


def as_role(targets: Targets, role: str) -> Targets:
    url = targets.graph_url.replace("postgres@", f"{role}@")
    return Targets(url, url)


@pytest.fixture
def _readers_use_cypher(pg: psycopg.Connection) -> None:
    version = extension_version(pg, "age") or ""
    if not enforces_row_security(version):
        pytest.skip(f"AGE {version} lets readers write, so mapfold_reader may not use cypher()")


@pytest.mark.usefixtures("_readers_use_cypher")
def test_a_reader_reads_and_cannot_write(log: Path, projected: Targets) -> None:
    reader = as_role(projected, "a_reader")
    for _ in range(2):  # before and after a rebuild by the owner
        with connect_for_cypher(reader.graph_url) as connection:
            paths = connection.execute(
                "SELECT * FROM cypher('semantic_map', $$ MATCH (o:Observation)-[:OBSERVES]->"
                "(b:Object)-[:LOCATED_IN]->(p:Place) RETURN count(*) $$) AS (n agtype)"
            ).fetchone()
            vectors = connection.execute("SELECT count(*) FROM detection_embeddings").fetchone()
            assert paths is not None
            assert vectors is not None
            assert int(paths[0]) > 0
            assert vectors[0] > 0
            for statement in (
                "DELETE FROM detection_embeddings",
                "UPDATE mapfold.checkpoint SET next_offset = 0",
                'DELETE FROM semantic_map."Place"',
            ):
                with pytest.raises(psycopg.errors.InsufficientPrivilege):
                    connection.execute(statement)
        assert [r.differing for r in check(log, reader, SETTINGS)] == [0, 0]
        assert projection_status(log, reader, SETTINGS).sinks[0].condition == "idle"
        rebuild(log, projected, SETTINGS)


def test_a_reader_cannot_tail(log: Path, projected: Targets) -> None:
    write_log(log, walk(5, first=40))
    with pytest.raises(DatabaseError, match="permission denied"):
        tail(log, as_role(projected, "a_reader"), SETTINGS, once=True)


@pytest.mark.slow
def test_a_writer_tails_and_cannot_rebuild(log: Path, projected: Targets) -> None:
    writer = as_role(projected, "a_writer")
    write_log(log, list(bridge()) + walk(20, first=40))
    assert tail(log, writer, SETTINGS, once=True).events == 40
    tailed = all_rows(projected)
    with pytest.raises(DatabaseError, match="permission denied"):
        rebuild(log, writer, SETTINGS)
    rebuild(log, projected, SETTINGS)
    assert all_rows(projected) == tailed
    write_log(log, walk(3, first=60))
    assert tail(log, writer, SETTINGS, once=True).events == 3


VERTEX = '{id: 844424930131969, label: "Run", properties: {run_id: "run-a"}}::vertex'
OTHER_VERTEX = '{id: 1125899906842625, label: "Keyframe", properties: {}}::vertex'
EDGE = (
    '{id: 2533274790395905, label: "HAS_KEYFRAME", start_id: 844424930131969,'
    " end_id: 1125899906842625, properties: {}}::edge"
)
"""Rows that the projection has, as a query can make them up without reading them."""
CYPHER = {
    "create": "CREATE (n:Run {run_id: 'new'}) RETURN n",
    "create a label": "CREATE (n:Foreign {run_id: 'new'}) RETURN n",
    "create an edge": "MATCH (a:Run), (b:Place) CREATE (a)-[:OBSERVES]->(b) RETURN a",
    "create an edge of made-up ends": f"WITH {VERTEX} AS n CREATE (n)-[:OBSERVES]->(n) RETURN n",
    "merge": "MERGE (n:Run {run_id: 'new'}) RETURN n",
    "set": "MATCH (n:Run) SET n.run_id = 'other' RETURN n",
    "set a map": "MATCH (n:Run) SET n += {x: 1} RETURN n",
    "set on an edge": "MATCH ()-[n:HAS_KEYFRAME]->() SET n.x = 1 RETURN n",
    "remove": "MATCH (n:Run) REMOVE n.started_at RETURN n",
    "delete": "MATCH ()-[n:OBSERVES]->() DELETE n RETURN n",
    "detach delete": "MATCH (n:Place) DETACH DELETE n RETURN n",
    "set on a made-up vertex": f"WITH {VERTEX} AS n SET n.run_id = 'other' RETURN n",
    "set on another": f"WITH {OTHER_VERTEX} AS n SET n.run_id = 'other' RETURN n",
    "set on a made-up edge": f"WITH {EDGE} AS n SET n.x = 1 RETURN n",
    "remove from a made-up vertex": f"WITH {VERTEX} AS n REMOVE n.run_id RETURN n",
    "delete a made-up edge": f"WITH {EDGE} AS n DELETE n RETURN n",
    "delete a made-up vertex": f"WITH {VERTEX} AS n DETACH DELETE n RETURN n",
}
FUNCTIONS = {
    "drop the graph": "drop_graph('semantic_map', true)",
    "drop a label": "drop_label('semantic_map', 'Place')",
    "make a vertex label": "create_vlabel('semantic_map', 'Foreign')",
    "make an edge label": "create_elabel('semantic_map', 'FOREIGN')",
    "rename the graph": "alter_graph('semantic_map', 'RENAME', 'other')",
    "make a complete graph": "create_complete_graph('semantic_map', 3, 'OBSERVES', 'Run')",
    "load vertices": "load_labels_from_file('semantic_map', 'Run', 'vertices.csv')",
    "load edges": "load_edges_from_file('semantic_map', 'HAS_KEYFRAME', 'edges.csv')",
    "take a number": "nextval('semantic_map._label_id_seq')",
}
WRITES = {
    **{
        name: f"SELECT * FROM ag_catalog.cypher('semantic_map', $q$ {text} $q$) AS (n agtype)"
        for name, text in CYPHER.items()
    },
    **{name: f"SELECT {call}" for name, call in FUNCTIONS.items()},
}
SESSIONS = {"as it comes": "SELECT 1", "without row security": "SET row_security = off"}


def attempt(url: str, session: str, statement: str) -> str:
    """Run a statement in a transaction of its own; what the server says."""
    with psycopg.connect(url) as connection:
        connection.execute('SELECT properties FROM semantic_map."Run"')  # loads AGE for anyone
        connection.execute(session)  # type: ignore[arg-type]
        connection.execute("SET search_path = ag_catalog, public")
        try:
            connection.execute(statement)  # type: ignore[arg-type]
        except psycopg.Error as error:
            connection.rollback()
            return str(error)
    return "done"


@pytest.mark.parametrize("session", mostly_slow(SESSIONS))
def test_no_form_of_writing_works_for_a_reader(projected: Targets, session: str) -> None:
    url = as_role(projected, "a_reader").graph_url
    before = all_rows(projected)
    for name, statement in every_other(WRITES.items()):
        said = attempt(url, SESSIONS[session], statement)
        assert all_rows(projected) == before, f"{name}: {said}"


@pytest.mark.usefixtures("_readers_use_cypher")
def test_a_writer_writes_through_cypher(projected: Targets) -> None:
    """So the attempts above are refused because of the role, not because of an error."""
    url = as_role(projected, "a_writer").graph_url
    for name in ("set", "set on another", "set on a made-up edge", "delete a made-up edge"):
        before = all_rows(projected)
        assert attempt(url, SESSIONS["as it comes"], WRITES[name]) == "done"
        assert all_rows(projected) != before, name


def test_the_rows_of_the_write_attempts_exist(projected: Targets, pg: psycopg.Connection) -> None:
    tables = pg.execute(
        "SELECT tableoid::regclass::text FROM semantic_map._ag_label_vertex"
        " WHERE id::text IN ('844424930131969', '1125899906842625')"
        " UNION ALL SELECT tableoid::regclass::text FROM semantic_map._ag_label_edge"
        " WHERE id::text = '2533274790395905'"
    ).fetchall()
    assert sorted(name for (name,) in tables) == [
        'semantic_map."HAS_KEYFRAME"', 'semantic_map."Keyframe"', 'semantic_map."Run"',
    ]  # fmt: skip


def test_without_row_security_readers_may_not_use_cypher_and_status_names_who_can_write(
    log: Path, projected: Targets, pg: psycopg.Connection
) -> None:
    """As it is with a graph of an earlier mapfold, or with an AGE that heeds no policies."""
    pg.execute('ALTER TABLE semantic_map."Run" DISABLE ROW LEVEL SECURITY')
    pg.execute("GRANT USAGE ON SCHEMA ag_catalog TO mapfold_reader")
    found = projection_status(log, projected, SETTINGS)
    assert found.sinks[0].unwanted_writers == ("a_reader", "mapfold_reader")
    assert not found.healthy
    heard: list[str | None] = []
    pg.add_notice_handler(lambda notice: heard.append(notice.message_primary))
    pg.execute(roles_sql())  # type: ignore[arg-type]
    assert any("mapfold_reader may not use cypher()" in str(message) for message in heard)
    found = projection_status(log, as_role(projected, "a_reader"), SETTINGS)
    assert found.healthy
    url = as_role(projected, "a_reader").graph_url
    with pytest.raises(ExtensionMissing, match="a_reader may not use Apache AGE"):
        connect_for_cypher(url)
    for ask in (
        lambda: CandidateReader(Targets(url, url)),
        lambda: check(log, Targets(url, url), SETTINGS),
    ):
        with pytest.raises(ExtensionMissing, match="a_reader may not use Apache AGE"):
            ask()
    with connect(url) as connection:
        assert connection.execute('SELECT properties FROM semantic_map."Place"').fetchall()


@pytest.mark.usefixtures("_readers_use_cypher")
@pytest.mark.slow
def test_a_rebuild_puts_row_security_on_a_graph_that_lacks_it(
    log: Path, projected: Targets, pg: psycopg.Connection
) -> None:
    pg.execute('ALTER TABLE semantic_map."Run" DISABLE ROW LEVEL SECURITY')
    rebuild(log, projected, SETTINGS)
    assert projection_status(log, projected, SETTINGS).healthy


@pytest.mark.slow
def test_a_writer_tails_many_events_at_once(log: Path, projected: Targets) -> None:
    """COPY, which a tail prefers then, cannot write tables under row-level security."""
    write_log(log, walk(300, first=40))
    writer = as_role(projected, "a_writer")
    assert tail(log, writer, SETTINGS, once=True, batch_events=300).events == 300
    assert [r.differing for r in check(log, projected, SETTINGS)] == [0, 0]


@pytest.mark.slow
def test_roles_reach_a_new_table_of_maps(log: Path, projected: Targets) -> None:
    """It gets the grants of the checkpoints where somebody dropped the last one."""
    given = drawn_map("####.###", 0.5)
    with connect(projected.graph_url, autocommit=True) as connection:
        connection.execute("DROP TABLE mapfold.occupancy_map")
    rebuild(log, projected, SETTINGS)
    with LogWriter(log) as writer:
        writer.append(MAP_KEY, given.encode())
    assert tail(log, as_role(projected, "a_writer"), SETTINGS, once=True).events == 1
    reader = as_role(projected, "a_reader")
    assert [row[-1] for row in map_rows(reader.graph_url)[:-1]] == [given.digest()]
    assert check(log, reader, SETTINGS)[0].differing == 0
    with (
        connect(reader.graph_url) as connection,
        pytest.raises(psycopg.errors.InsufficientPrivilege),
    ):
        connection.execute("DELETE FROM mapfold.occupancy_map")
