"""What docs/projections.md promises about the two least-privilege roles."""

from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from projections.errors import DatabaseError
from projections.postgres.connect import Targets, connect_for_cypher
from projections.runner import rebuild, tail
from projections.runner.check import check
from projections.runner.status import projection_status
from projections.settings import Settings
from projections.sinks.roles import roles_sql
from tests.logs import bridge, walk, write_log
from tests.rows import all_rows

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
    for role in ROLES:
        pg.execute(f"DROP OWNED BY {role}")  # type: ignore[arg-type]
    for role in ROLES:
        pg.execute(f"DROP ROLE {role}")  # type: ignore[arg-type]


def as_role(targets: Targets, role: str) -> Targets:
    url = targets.graph_url.replace("postgres@", f"{role}@")
    return Targets(url, url)


def test_a_reader_reads_and_writes_nothing(log: Path, projected: Targets) -> None:
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
