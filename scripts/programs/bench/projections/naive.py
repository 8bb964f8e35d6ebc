"""The straightforward way: a MERGE for each node and each edge, one transaction per keyframe.

What a graph-builder service beside an ingest service does, by the recipes of the AGE manual:

* one Cypher statement a node and one an edge, each its own round trip: seven for the keyframe
  (run, keyframe, pose, place and their edges), six for a detection, one for adjacency: 26 for a
  keyframe with three detections
* MERGE throughout, so that a keyframe sent twice does no harm; nodes are matched by their
  properties, ``{det_id: $det_id}``; labels are there, indexes are not
* parameters are bound, never spliced; psycopg prepares what it sees often, by itself
* the embeddings go to pgvector one INSERT each, in a transaction of their own, its index on det_id
  only

It is given the finished places and objects, so its time is that of writing alone.
"""

import json
import time
from typing import Any, LiteralString

import psycopg
from pgvector.psycopg import register_vector

from projections.fold.exact import to_float32
from projections.map.view import MapView
from projections.postgres.connection import connect
from projections.postgres.cypher import connect_for_cypher

VERTICES = ("Run", "Keyframe", "Pose", "Observation", "Object", "Place")
EDGES = ("HAS_KEYFRAME", "HAS_POSE", "HAS_OBSERVATION", "OBSERVES", "LOCATED_IN", "IN_PLACE",
         "ADJACENT_TO")  # fmt: skip

KEYFRAME: tuple[LiteralString, ...] = (
    "MERGE (r:Run {run_id: $run_id}) RETURN 1",
    (
        "MERGE (k:Keyframe {run_id: $run_id, keyframe_id: $keyframe_id})"
        " SET k.timestamp = $timestamp RETURN 1"
    ),
    (
        "MATCH (r:Run {run_id: $run_id}), (k:Keyframe {run_id: $run_id, keyframe_id: $keyframe_id})"
        " MERGE (r)-[:HAS_KEYFRAME]->(k) RETURN 1"
    ),
    (
        "MERGE (p:Pose {run_id: $run_id, keyframe_id: $keyframe_id})"
        " SET p.map_x = $x, p.map_y = $y, p.map_yaw = $yaw RETURN 1"
    ),
    (
        "MATCH (k:Keyframe {run_id: $run_id, keyframe_id: $keyframe_id}),"
        " (p:Pose {run_id: $run_id, keyframe_id: $keyframe_id}) MERGE (k)-[:HAS_POSE]->(p) RETURN 1"
    ),
)
PLACE: tuple[LiteralString, ...] = (
    (
        "MERGE (p:Place {place_id: $place_id}) SET p.centroid_x = $centroid_x,"
        " p.centroid_y = $centroid_y, p.keyframe_count = $keyframe_count RETURN 1"
    ),
    (
        "MATCH (k:Keyframe {run_id: $run_id, keyframe_id: $keyframe_id}), (p:Place {place_id:"
        " $place_id}) MERGE (k)-[:IN_PLACE]->(p) RETURN 1"
    ),
)
ADJACENT: LiteralString = (
    "MATCH (a:Place {place_id: $a}), (b:Place {place_id: $b}) MERGE (a)-[e:ADJACENT_TO]->(b)"
    " SET e.shared_transitions = $shared_transitions RETURN 1"
)
DETECTION: tuple[LiteralString, ...] = (
    (
        "MERGE (o:Observation {det_id: $det_id}) SET o.class_name = $class_name,"
        " o.confidence = $confidence, o.bbox = $bbox, o.run_id = $run_id,"
        " o.keyframe_id = $keyframe_id RETURN 1"
    ),
    (
        "MATCH (k:Keyframe {run_id: $run_id, keyframe_id: $keyframe_id}), (o:Observation {det_id:"
        " $det_id}) MERGE (k)-[:HAS_OBSERVATION]->(o) RETURN 1"
    ),
)
OBJECT: tuple[LiteralString, ...] = (
    (
        "MERGE (b:Object {object_id: $object_id}) SET b.class_name = $class_name,"
        " b.mean_x = $mean_x, b.mean_y = $mean_y, b.obs_count = $obs_count RETURN 1"
    ),
    (
        "MATCH (o:Observation {det_id: $det_id}), (b:Object {object_id: $object_id})"
        " MERGE (o)-[e:OBSERVES]->(b) SET e.similarity = $similarity RETURN 1"
    ),
)
LOCATED: tuple[LiteralString, ...] = (
    (
        "MATCH (b:Object {object_id: $object_id})-[e:LOCATED_IN]->(p:Place)"
        " WHERE p.place_id <> $place_id DELETE e RETURN 1"
    ),
    (
        "MATCH (b:Object {object_id: $object_id}), (p:Place {place_id: $place_id})"
        " MERGE (b)-[:LOCATED_IN]->(p) RETURN 1"
    ),
)
INSERT: LiteralString = (
    "INSERT INTO naive_embeddings VALUES (%s, %s, %s, %s, %s, %s, %s, %s, %s)"
    " ON CONFLICT (det_id) DO NOTHING"
)


def write_naively(url: str, view: MapView) -> tuple[float, float]:
    """Write a view; seconds for the graph and for the vectors."""
    with connect_for_cypher(url) as graph, connect(url, autocommit=True) as vectors:
        _prepare_graph(graph)
        _prepare_table(vectors)
        started = time.perf_counter()
        before: int | None = None
        for k in view.keyframes:
            with graph.transaction():
                before = _write_keyframe(graph, view, k, before)
        middle = time.perf_counter()
        for k in view.keyframes:
            with vectors.transaction():
                _write_vectors(vectors, view, k)
        return middle - started, time.perf_counter() - middle


def _prepare_graph(connection: psycopg.Connection[Any]) -> None:
    connection.execute("SET client_min_messages = warning")
    connection.execute("SELECT drop_graph(name, true) FROM ag_graph WHERE name = 'naive_map'")
    connection.execute("SELECT create_graph('naive_map')")
    for label in VERTICES:
        connection.execute("SELECT create_vlabel('naive_map', %s)", [label])
    for label in EDGES:
        connection.execute("SELECT create_elabel('naive_map', %s)", [label])


def _prepare_table(connection: psycopg.Connection[Any]) -> None:
    register_vector(connection)
    connection.execute("DROP TABLE IF EXISTS naive_embeddings")
    connection.execute(
        "CREATE TABLE naive_embeddings (run_id text, det_id text UNIQUE, keyframe_id bigint,"
        " class_name text, confidence float8, map_x float8, map_y float8, map_yaw float8,"
        " embedding vector(512))"
    )


def _run(connection: psycopg.Connection[Any], query: LiteralString, values: Any) -> None:
    connection.execute(
        "SELECT * FROM cypher('naive_map', $cypher$" + query + "$cypher$, %s) AS (n agtype)",
        [json.dumps(values)],
    )


def _write_keyframe(
    connection: psycopg.Connection[Any], view: MapView, k: Any, before: int | None
) -> int | None:
    """One keyframe with its detections; returns its place, or the last one before it."""
    values = {"run_id": k.run_id, "keyframe_id": k.keyframe_id, "timestamp": k.timestamp}
    values |= {"x": k.pose.x_um / 1e6, "y": k.pose.y_um / 1e6, "yaw": k.pose.yaw_rad}
    for query in KEYFRAME:
        _run(connection, query, values)
    place = view.places.get(k.place)
    if place is not None:
        values |= {"place_id": place.place_id, "keyframe_count": place.keyframe_count}
        values |= {"centroid_x": place.centroid_x, "centroid_y": place.centroid_y}
        for query in PLACE:
            _run(connection, query, values)
        if before not in (None, k.place):
            _write_adjacency(connection, view, before, k.place)
    for ordinal in k.observations:
        _write_detection(connection, view, values, view.observations[ordinal])
    return before if place is None else k.place


def _write_adjacency(
    connection: psycopg.Connection[Any], view: MapView, before: int | None, place: int
) -> None:
    a, b = sorted((before or 0, place))
    pair = {"a": view.places[a].place_id, "b": view.places[b].place_id}
    _run(connection, ADJACENT, {**pair, "shared_transitions": view.adjacency.get((a, b), 0)})


def _write_detection(
    connection: psycopg.Connection[Any], view: MapView, keyframe: dict[str, Any], o: Any
) -> None:
    values = {"det_id": o.det_id, "class_name": o.class_name, "confidence": o.confidence}
    values |= {"bbox": list(o.bbox)}
    values |= {"run_id": keyframe["run_id"], "keyframe_id": keyframe["keyframe_id"]}
    for query in DETECTION:
        _run(connection, query, values)
    if o.object is None:
        return
    found = view.objects[o.object]
    values |= {"object_id": found.object_id, "obs_count": found.obs_count}
    values |= {"mean_x": found.mean_x, "mean_y": found.mean_y}
    values |= {"similarity": o.similarity_q40 / 2**40}
    for query in OBJECT:
        _run(connection, query, values)
    if found.place is not None:
        values |= {"place_id": view.places[found.place].place_id}
        for query in LOCATED:
            _run(connection, query, values)


def _write_vectors(connection: psycopg.Connection[Any], view: MapView, k: Any) -> None:
    for ordinal in k.observations:
        o = view.observations[ordinal]
        connection.execute(
            INSERT,
            [k.run_id, o.det_id, k.keyframe_id, o.class_name, o.confidence, k.pose.x_um / 1e6,
             k.pose.y_um / 1e6, k.pose.yaw_rad, to_float32(o.embedding)],
        )  # fmt: skip
