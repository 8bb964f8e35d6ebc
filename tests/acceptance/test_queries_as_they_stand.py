"""The two queries of the design, from a plain client, say what ``mapfold state --json`` says."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import pytest

from eventsrc.envelope.ingest import Accepted, ingest
from tests.acceptance.awkward_run import CLASSES, RUNS, awkward_payloads
from tests.support.commands import Commands

KNN = """
    SELECT det_id, embedding <=> %s::vector AS distance FROM detection_embeddings
    ORDER BY distance LIMIT 10
"""
TRAVERSAL = """
    SELECT place_id, x, y, class_name
    FROM cypher('semantic_map', $$
        MATCH (obs:Observation)-[:OBSERVES]->(obj:Object)-[:LOCATED_IN]->(p:Place)
        WHERE obs.det_id = $det_id
        RETURN p.place_id, p.centroid_x, p.centroid_y, obj.class_name
    $$, %s) AS (place_id agtype, x agtype, y agtype, class_name agtype)
"""
INLINE = """
    SELECT place_id, x, y, class_name
    FROM cypher('semantic_map', $$
        MATCH (obs:Observation {det_id: 'plain_kf1_d0'})
              -[:OBSERVES]->(obj:Object)-[:LOCATED_IN]->(p:Place)
        RETURN p.place_id, p.centroid_x, p.centroid_y, obj.class_name
    $$) AS (place_id agtype, x agtype, y agtype, class_name agtype)
"""
LABELS = {
    "Run": "runs", "Keyframe": "keyframes", "Observation": "observations", "Object": "objects",
    "Place": "places",
}  # fmt: skip


@pytest.fixture(scope="module")
def replayed(mapfold: Commands, awkward_log: Path) -> dict[str, Any]:
    """The state of the log that was just replayed into the databases."""
    mapfold("replay", awkward_log)
    state: dict[str, Any] = mapfold("state", awkward_log, "--json").json
    return state


@pytest.fixture
def client(mapfold: Commands, replayed: dict[str, Any]) -> psycopg.Connection:
    """A connection as any PostgreSQL client would make it, without our code."""
    connection = psycopg.connect(mapfold("db", "url").out.strip(), autocommit=True)
    connection.execute("LOAD 'age'")
    connection.execute('SET search_path = ag_catalog, "$user", public')
    return connection


def test_the_awkward_run_has_places_and_objects(replayed: dict[str, Any]) -> None:
    assert len(replayed["places"]) == 4
    assert {o["class_name"] for o in replayed["objects"]} == set(CLASSES[:4])
    assert {k["run_id"] for k in replayed["keyframes"]} == set(RUNS)


def test_every_observation_leads_to_its_object_and_place(
    client: psycopg.Connection, replayed: dict[str, Any]
) -> None:
    places = {p["place_id"]: p for p in replayed["places"]}
    asked = 0
    with client:
        for found in replayed["objects"]:
            place = places[found["place_id"]]
            for det_id in found["det_ids"]:
                rows = client.execute(TRAVERSAL, [json.dumps({"det_id": det_id})]).fetchall()
                assert [tuple(map(json.loads, row)) for row in rows] == [
                    (
                        place["place_id"],
                        place["centroid_x"],
                        place["centroid_y"],
                        found["class_name"],
                    )
                ]
                asked += 1
    assert asked == 32


def test_nearest_vectors_are_the_observations_own(
    client: psycopg.Connection, replayed: dict[str, Any]
) -> None:
    with client:
        for raw in awkward_payloads()[::7]:
            read = ingest(raw)
            assert isinstance(read, Accepted)
            for det_id, vector in zip(read.det_ids, read.vectors, strict=True):
                if vector is None:
                    continue
                rows = client.execute(KNN, [json.dumps(vector.tolist())]).fetchall()
                assert rows[0][0] == det_id
                assert abs(rows[0][1]) < 1e-5
                assert len(rows) == 10


def test_vectors_in_the_table_are_unit_vectors(client: psycopg.Connection) -> None:
    with client:
        rows = client.execute("SELECT embedding::text FROM detection_embeddings").fetchall()
    norms = [float(np.linalg.norm(json.loads(text))) for (text,) in rows]
    assert len(norms) == 32
    assert all(abs(norm - 1.0) < 1e-5 for norm in norms)


@pytest.mark.parametrize(("label", "counted"), LABELS.items())
def test_node_counts_equal_the_states(
    client: psycopg.Connection, replayed: dict[str, Any], label: str, counted: str
) -> None:
    with client:
        found = client.execute(
            psycopg.sql.SQL("SELECT count(*) FROM semantic_map.{}").format(
                psycopg.sql.Identifier(label)
            )
        ).fetchone()
    assert found == (replayed["counts"][counted],)


def test_edge_counts_equal_the_states(client: psycopg.Connection, replayed: dict[str, Any]) -> None:
    keyframes = replayed["keyframes"]
    expected = {
        "HAS_KEYFRAME": len(keyframes),
        "HAS_POSE": sum(k["map_x"] is not None for k in keyframes),
        "HAS_OBSERVATION": replayed["counts"]["observations"],
        "OBSERVES": sum(len(o["det_ids"]) for o in replayed["objects"]),
        "LOCATED_IN": sum(o["place_id"] is not None for o in replayed["objects"]),
        "IN_PLACE": sum(k["place_id"] is not None for k in keyframes),
        "ADJACENT_TO": len(replayed["adjacency"]),
    }
    query = psycopg.sql.SQL("SELECT count(*) FROM semantic_map.{}")
    with client:
        found = {
            label: client.execute(query.format(psycopg.sql.Identifier(label))).fetchone()
            for label in expected
        }
    assert found == {label: (count,) for label, count in expected.items()}


def test_the_inline_form_of_the_traversal_stands(mapfold: Commands) -> None:
    log = mapfold.folder / "plain"
    renamed = [
        raw.replace(json.dumps(RUNS[0]).encode(), b'"plain"') for raw in awkward_payloads()[:16]
    ]
    mapfold("import", log, "-", stdin=b"\n".join(renamed) + b"\n")
    mapfold("replay", log)
    state = mapfold("state", log, "--json").json
    founded = next(o for o in state["objects"] if "plain_kf1_d0" in o["det_ids"])
    with psycopg.connect(mapfold("db", "url").out.strip(), autocommit=True) as connection:
        connection.execute("LOAD 'age'")
        connection.execute('SET search_path = ag_catalog, "$user", public')
        rows = connection.execute(INLINE).fetchall()
    assert [json.loads(row[0]) for row in rows] == [founded["place_id"]]
    assert json.loads(rows[0][3]) == founded["class_name"]
