"""The two queries of docs/projections.md at 300,000 observations."""

import json
import statistics
import time
from pathlib import Path
from typing import Any, LiteralString

import numpy as np
import psycopg

from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.postgres.cypher import connect_for_cypher
from projections.postgres.embedded import EmbeddedServer

from .world import make_log

QUERIES = 200
TRAVERSAL = (
    "SELECT * FROM cypher('semantic_map', $$ UNWIND $ids AS d"
    " MATCH (obs:Observation)-[:OBSERVES]->(obj:Object)-[:LOCATED_IN]->(p:Place)"
    " WHERE obs.det_id = d"
    " RETURN p.place_id, p.centroid_x, p.centroid_y, obj.class_name $$, %s)"
    " AS (place_id agtype, x agtype, y agtype, class_name agtype)"
)
NEAREST = (
    "SELECT det_id, embedding <=> %(probe)s::public.vector AS distance FROM (SELECT *"
    " FROM detection_embeddings ORDER BY embedding::halfvec(512) <=> %(probe)s::public.vector"
    " LIMIT 40) AS near ORDER BY distance LIMIT 10"
)
EXACT = (
    "SELECT det_id, embedding <=> %(probe)s::public.vector AS distance FROM detection_embeddings"
    " ORDER BY distance LIMIT 10"
)


def both(server: EmbeddedServer, folder: Path, quick: bool) -> None:
    """Traversal of ten det_ids, and KNN with HNSW with its recall."""
    size = 20_000 if quick else 100_000
    log = make_log(folder / f"log-{size}", size)
    report = rebuild(log, Targets(server.url, server.url), Settings())
    print(f"queries: {report.counts['observations']} observations,"
          f" rebuilt in {report.total_s:.0f} s ({report.hnsw})")  # fmt: skip
    rng = np.random.default_rng(3)
    with connect_for_cypher(server.url) as connection:
        _traversal(connection, report.counts["observations"], rng)
        _nearest(connection, report.counts["observations"], rng)


def _traversal(connection: psycopg.Connection[Any], count: int, rng: np.random.Generator) -> None:
    times, rows = [], 0
    for _ in range(QUERIES):
        picks = [int(i) + 1 for i in rng.integers(count, size=10)]
        found = connection.execute(
            "SELECT det_id FROM detection_embeddings WHERE det_pk = ANY(%s)", [picks]
        ).fetchall()
        parameters = json.dumps({"ids": [row[0] for row in found]})
        started = time.perf_counter()
        rows += len(connection.execute(TRAVERSAL, [parameters], prepare=True).fetchall())
        times.append(1000 * (time.perf_counter() - started))
    print(f"  traversal of ten det_ids: p50 {statistics.median(times):.2f} ms"
          f" ({rows / QUERIES:.1f} rows)")  # fmt: skip


def _nearest(connection: psycopg.Connection[Any], count: int, rng: np.random.Generator) -> None:
    picks = [int(i) + 1 for i in rng.integers(count, size=QUERIES)]
    probes = []
    for pick in picks:
        row = connection.execute(
            "SELECT embedding::real[] FROM detection_embeddings WHERE det_pk = %s", [pick]
        ).fetchone()
        assert row is not None
        vector = np.array(row[0]) + 0.02 * rng.normal(size=512)  # near a known one, as a crop is
        probes.append("[" + ",".join(f"{v:.7g}" for v in vector) + "]")
    for ef in (40, 100, 200):
        connection.execute(f"SET hnsw.ef_search = {ef}")  # type: ignore[arg-type]
        times, answers = _ask(connection, NEAREST, probes)
        _, exact = _ask(connection, EXACT, probes[:40])
        recall = np.mean([len(a & e) / 10 for a, e in zip(answers, exact, strict=False)])
        print(f"  nearest 10, ef_search {ef}: p50 {statistics.median(times):.2f} ms,"
              f" recall@10 {recall:.3f}")  # fmt: skip


def _ask(
    connection: psycopg.Connection[Any], query: LiteralString, probes: list[str]
) -> tuple[list[float], list[set[str]]]:
    times, answers = [], []
    for probe in probes:
        started = time.perf_counter()
        rows = connection.execute(query, {"probe": probe}, prepare=True).fetchall()
        times.append(1000 * (time.perf_counter() - started))
        answers.append({row[0] for row in rows})
    return times, answers
