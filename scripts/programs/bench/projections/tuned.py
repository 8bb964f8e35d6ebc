"""Per-node Cypher, tuned as far as it stays per-node Cypher, one transaction per keyframe.

Property indexes made up front, expressions that use them, CREATE for what must be new, prepared
statements. It writes the graph only, without adjacency. See `naive` for the usual way.
"""

import json
import time
from typing import Any, LiteralString

import psycopg

from projections.map.view import MapView
from projections.postgres.cypher import connect_for_cypher

GRAPH: LiteralString = "tuned_map"

NODES: tuple[tuple[str, str], ...] = (
    ("Run", "run_id"), ("Keyframe", "id"), ("Pose", "id"), ("Observation", "det_id"),
    ("Object", "object_id"), ("Place", "place_id"),
)  # fmt: skip
EDGES = ("HAS_KEYFRAME", "HAS_POSE", "HAS_OBSERVATION", "OBSERVES", "LOCATED_IN", "IN_PLACE")

_RUN = "MERGE (r:Run {run_id: $run_id}) SET r.started_at = $timestamp RETURN 1"
_KEYFRAME = (
    "MATCH (r:Run) WHERE r.run_id = $run_id CREATE (k:Keyframe {id: $id, run_id: $run_id,"
    " keyframe_id: $keyframe_id, timestamp: $timestamp}) CREATE (r)-[:HAS_KEYFRAME]->(k) RETURN 1"
)
_POSE = (
    "MATCH (k:Keyframe) WHERE k.id = $id CREATE (p:Pose {id: $id, map_x: $x, map_y: $y,"
    " map_yaw: $yaw}) CREATE (k)-[:HAS_POSE]->(p) RETURN 1"
)
_PLACE = (
    "MERGE (p:Place {place_id: $place_id}) SET p.keyframe_count = $count, p.centroid_x = $x,"
    " p.centroid_y = $y RETURN 1"
)
_IN_PLACE = (
    "MATCH (k:Keyframe), (p:Place) WHERE k.id = $id AND p.place_id = $place_id"
    " CREATE (k)-[:IN_PLACE]->(p) RETURN 1"
)
_OBSERVATION = (
    "MATCH (k:Keyframe) WHERE k.id = $id CREATE (o:Observation {det_id: $det_id, class_name:"
    " $class_name, confidence: $confidence, bbox: $bbox}) CREATE (k)-[:HAS_OBSERVATION]->(o)"
    " RETURN 1"
)
_OBJECT = (
    "MERGE (b:Object {object_id: $object_id}) SET b.class_name = $class_name, b.mean_x = $x,"
    " b.mean_y = $y, b.obs_count = $count RETURN 1"
)
_OBSERVES = (
    "MATCH (o:Observation), (b:Object) WHERE o.det_id = $det_id AND b.object_id = $object_id"
    " CREATE (o)-[:OBSERVES {similarity: $similarity}]->(b) RETURN 1"
)
_LOCATED = (
    "MATCH (b:Object), (p:Place) WHERE b.object_id = $object_id AND p.place_id = $place_id"
    " MERGE (b)-[:LOCATED_IN]->(p) RETURN 1"
)


def write_tuned(url: str, view: MapView) -> float:
    """Write the whole view; seconds it took."""
    with connect_for_cypher(url) as connection:
        _prepare(connection)
        started = time.perf_counter()
        for k in view.keyframes:
            with connection.transaction():
                _write_keyframe(connection, view, k)
        return time.perf_counter() - started


def _prepare(connection: psycopg.Connection[Any]) -> None:
    connection.execute("SET client_min_messages = warning")
    connection.execute("SELECT drop_graph(name, true) FROM ag_graph WHERE name = 'tuned_map'")
    connection.execute("SELECT create_graph('tuned_map')")
    for label, key in NODES:
        connection.execute("SELECT create_vlabel('tuned_map', %s)", [label])
        connection.execute(
            f'CREATE INDEX ON tuned_map."{label}" (agtype_access_operator(properties,'  # type: ignore[arg-type]
            f" '\"{key}\"'::agtype))"
        )
    for label in EDGES:
        connection.execute("SELECT create_elabel('tuned_map', %s)", [label])


def _run(connection: psycopg.Connection[Any], query: str, **parameters: Any) -> None:
    connection.execute(
        "SELECT * FROM cypher('tuned_map', $cypher$" + query + "$cypher$, %s) AS (n agtype)",  # type: ignore[arg-type]
        [json.dumps(parameters)],
        prepare=True,
    )


def _write_keyframe(connection: psycopg.Connection[Any], view: MapView, k: Any) -> None:
    key = f"{k.run_id}/{k.keyframe_id}"
    _run(connection, _RUN, run_id=k.run_id, timestamp=k.timestamp)
    _run(connection, _KEYFRAME, id=key, run_id=k.run_id, keyframe_id=k.keyframe_id,
         timestamp=k.timestamp)  # fmt: skip
    if k.pose is not None:
        _run(connection, _POSE, id=key, x=k.pose.x_um / 1e6, y=k.pose.y_um / 1e6,
             yaw=k.pose.yaw_rad)  # fmt: skip
    if k.place is not None:
        place = view.places[k.place]
        _run(connection, _PLACE, place_id=place.place_id, count=place.keyframe_count,
             x=place.centroid_x, y=place.centroid_y)  # fmt: skip
        _run(connection, _IN_PLACE, id=key, place_id=place.place_id)
    for ordinal in k.observations:
        _write_observation(connection, view, key, view.observations[ordinal])


def _write_observation(
    connection: psycopg.Connection[Any], view: MapView, key: str, o: Any
) -> None:
    _run(connection, _OBSERVATION, id=key, det_id=o.det_id, class_name=o.class_name,
         confidence=o.confidence, bbox=list(o.bbox))  # fmt: skip
    if o.object is None:
        return
    found = view.objects[o.object]
    _run(connection, _OBJECT, object_id=found.object_id, class_name=found.class_name,
         x=found.mean_x, y=found.mean_y, count=found.obs_count)  # fmt: skip
    _run(connection, _OBSERVES, det_id=o.det_id, object_id=found.object_id,
         similarity=o.similarity_q40 / 2**40)  # fmt: skip
    if found.place is not None:
        _run(connection, _LOCATED, object_id=found.object_id,
             place_id=view.places[found.place].place_id)  # fmt: skip
