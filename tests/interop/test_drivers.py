"""The databases by other drivers than ours, and dumped and restored by PostgreSQL's own tools."""

import subprocess
from pathlib import Path

import asyncpg
import numpy as np
import pgserver
import psycopg
import pytest
import sqlalchemy
from pgvector.sqlalchemy import Vector
from psycopg.conninfo import conninfo_to_dict

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.view import MapView
from projections.postgres import rebuild
from projections.postgres.check import check
from projections.postgres.connection import Targets
from tests.support.event_loops import run_apart
from tests.support.logs import sample_drive

SAMPLE = sample_drive()
SETTINGS = Settings(eps_m=0.75, min_samples=8)
PLACES = (
    "SELECT * FROM cypher('semantic_map', $$ MATCH (p:Place) RETURN p.place_id, p.centroid_x"
    " ORDER BY p.place_id $$) AS (place_id agtype, x agtype)"
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def view() -> MapView:
    with LogReader(SAMPLE) as reader:
        return fold_log(reader, SETTINGS)[1]


@pytest.fixture
def filled(one_database: Targets) -> Targets:
    rebuild(SAMPLE, one_database, SETTINGS)
    return one_database


def places_of(view: MapView) -> list[tuple[str, float]]:
    return sorted((place.place_id, place.centroid_x) for place in view.places.values())


def test_asyncpg(filled: Targets, view: MapView) -> None:
    async def read() -> tuple[list[asyncpg.Record], list[asyncpg.Record]]:
        at = conninfo_to_dict(filled.graph_url)
        connection = await asyncpg.connect(host=at["host"], user=at["user"], database=at["dbname"])
        try:
            await connection.execute("LOAD 'age'")
            await connection.execute('SET search_path = ag_catalog, "$user", public')
            places = await connection.fetch(PLACES)
            vectors = await connection.fetch(
                "SELECT det_id, embedding::text AS embedding FROM public.detection_embeddings"
                " WHERE class_name = $1 ORDER BY det_id",
                "toilet",
            )
        finally:
            await connection.close()
        return places, vectors

    places, vectors = run_apart(read())
    found = [(row["place_id"].strip('"'), float(row["x"])) for row in places]
    assert sorted(found) == places_of(view)
    seen = {o.det_id: o.embedding for o in view.observations if o.class_name == "toilet"}
    assert [row["det_id"] for row in vectors] == sorted(seen)
    for row in vectors:
        unit = np.array(seen[row["det_id"]]) / 2**20
        told = np.array([float(text) for text in row["embedding"].strip("[]").split(",")])
        assert told / np.linalg.norm(told) == pytest.approx(unit, abs=2e-6)


def test_sqlalchemy(filled: Targets, view: MapView) -> None:
    engine = sqlalchemy.create_engine(
        "postgresql+psycopg://", creator=lambda: psycopg.connect(filled.graph_url)
    )
    with engine.connect() as connection:
        connection.execute(sqlalchemy.text("LOAD 'age'"))
        connection.execute(sqlalchemy.text('SET search_path = ag_catalog, "$user", public'))
        found = [(str(a).strip('"'), float(b)) for a, b in connection.exec_driver_sql(PLACES)]
        table = sqlalchemy.Table(
            "detection_embeddings", sqlalchemy.MetaData(), schema="public", autoload_with=engine
        )
        count = connection.execute(
            sqlalchemy.select(sqlalchemy.func.count()).select_from(table)
        ).scalar_one()
    engine.dispose()
    assert isinstance(table.c.embedding.type, Vector)
    assert sorted(found) == places_of(view)
    assert count == view.counts()["observations"]


def test_a_dump_restored_elsewhere_passes_the_check(
    filled: Targets, third_database: Targets, tmp_path: Path
) -> None:
    programs = Path(pgserver.__file__).parent / "pginstall" / "bin"
    dump = tmp_path / "dump"

    def run(program: str, *arguments: str | Path) -> None:
        done = subprocess.run(
            [programs / program, *arguments], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr

    run("pg_dump", "--format=custom", f"--file={dump}", filled.graph_url)
    run("pg_restore", "--clean", "--if-exists", f"--dbname={third_database.graph_url}", dump)
    assert [r.differing for r in check(SAMPLE, third_database, SETTINGS)] == [0, 0]
