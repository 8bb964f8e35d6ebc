"""Floors in the databases: replay, tail and check agree."""

import json
from pathlib import Path

import psycopg
import pytest

from projections.fold.settings import Settings
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from tests.integration.test_projections import parsed, view_of
from tests.support.logs import bridge, walk, write_log
from tests.support.rows import all_rows, expected_graph, graph_rows

SETTINGS = Settings()
HOSTILE = 'x\'}) DETACH DELETE r // \\ "q" $$'


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Two runs on three floors and one without a name; places merge on each of them."""
    floors = [{"floor": HOSTILE}, {"floor": 2}, {"map_z": 9.2}, {}]
    documents = (
        walk(160) + walk(60, run_id="run-c", seed=3) + list(bridge()) + list(bridge("run-d"))
    )
    return write_log(
        tmp_path / "log",
        [{**each, **floors[n // 25 % 4]} for n, each in enumerate(documents)],
    )


def test_replay_and_tail_write_the_floors_of_the_fold_and_check_finds_them_sound(
    log: Path, one_database: Targets
) -> None:
    tail(log, one_database, SETTINGS, once=True, batch_events=7)
    view = view_of(log)
    assert len(view.floors) == 3
    assert any(view.is_between_floors(a, b) for a, b, _ in view.edges())
    followed = all_rows(one_database)
    assert parsed(graph_rows(one_database.graph_url)) == expected_graph(view)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == followed
    assert all(report.sound for report in check(log, one_database, SETTINGS))


def test_the_way_from_a_place_to_its_building(log: Path, one_database: Targets) -> None:
    rebuild(log, one_database, SETTINGS)
    view = view_of(log)
    with psycopg.connect(one_database.graph_url, autocommit=True) as connection:
        connection.execute("LOAD 'age'")
        connection.execute('SET search_path = ag_catalog, "$user", public')
        query = (
            "SELECT * FROM cypher('semantic_map', $c$ MATCH (p:Place)-[:PART_OF]->(f:Floor)"
            "-[:PART_OF]->(b:Building) RETURN p.place_id, f.floor, b.building_id $c$)"
            " AS (place agtype, floor agtype, building agtype)"
        )
        found = {tuple(map(json.loads, row)) for row in connection.execute(query).fetchall()}
    assert found == {
        (place.place_id, floor, "building")
        for place in view.places.values()
        if (floor := view.floor_of(place.ordinal)) is not None
    }
    assert len({floor for _, floor, _ in found}) == 3


def test_check_names_a_wrong_floor(log: Path, one_database: Targets) -> None:
    rebuild(log, one_database, SETTINGS)
    with psycopg.connect(one_database.graph_url, autocommit=True) as connection:
        connection.execute("SET search_path = ag_catalog, public")
        connection.execute(
            'DELETE FROM semantic_map."PART_OF" WHERE start_id = (SELECT id FROM'
            ' semantic_map."Floor" ORDER BY id LIMIT 1)'
        )
    graph, _ = check(log, one_database, SETTINGS)
    (difference,) = graph.differences
    assert (difference.table, difference.kind) == ("PART_OF", "missing")
