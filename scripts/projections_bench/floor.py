"""The floor of a rebuild: COPY of the very same rows from ready files, and reading the log.

It leaves out folding, making rows, our own indexes, and the commit, which writes all of it to disk
(with ``wal_level=minimal`` nothing is on disk before). The commit is timed apart.
"""

import time
from pathlib import Path
from typing import Any

import psycopg
from psycopg import sql

from eventsrc.log import LogReader
from projections.folding import fold_log
from projections.postgres.connect import Targets, connect
from projections.postgres.embedded import EmbeddedServer
from projections.runner import rebuild
from projections.settings import Settings
from projections.sinks import _graph_ddl
from projections.sinks.labels import GRAPH, LABELS

from .world import make_log

FLOOR_GRAPH = "floor_map"
REPEATS = 3


def against_floor(server: EmbeddedServer, folder: Path, quick: bool) -> None:
    """One in-process rebuild of 20,000 keyframes without HNSW, against its floor."""
    size = 2_000 if quick else 20_000
    log = make_log(folder / f"log-{size}", size)
    targets = Targets(server.url, server.url)
    whole = min(rebuild(log, targets, Settings(), hnsw=False).total_s for _ in range(REPEATS))
    with connect(server.url, autocommit=True) as connection:
        connection.execute("SET client_min_messages = warning")
        files = _dump(connection, folder)
        timed = [_copy(connection, files) for _ in range(REPEATS)]
    copies, commits, indexes = zip(*timed, strict=True)
    reading = min(_read(log) for _ in range(REPEATS))
    started = time.perf_counter()
    with LogReader(log) as reader:
        fold_log(reader, Settings(), keep_embeddings=False)
    fold = time.perf_counter() - started
    floor = min(copies) + reading
    print(f"floor of {size} keyframes: COPY {min(copies):.2f} s + reading {reading:.2f} s ="
          f" {floor:.2f} s; rebuild {whole:.2f} s; ratio {whole / floor:.2f}")  # fmt: skip
    committed = floor + min(commits)
    print(
        f"  of the rest: reading and folding {fold:.2f} s, indexes {min(indexes):.2f} s,"
        f" commit {min(commits):.2f} s; with the commit the ratio is {whole / committed:.2f}"
    )


def _dump(connection: psycopg.Connection[Any], folder: Path) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for label in LABELS:
        query = sql.SQL("COPY {} TO STDOUT").format(sql.Identifier(GRAPH, label))
        files[label] = _write(connection, query, folder / f"{label}.copy")
    query = sql.SQL("COPY public.detection_embeddings TO STDOUT (FORMAT binary)").format()
    files["vectors"] = _write(connection, query, folder / "vectors.copy")
    return files


def _write(connection: psycopg.Connection[Any], query: sql.Composed, path: Path) -> Path:
    with connection.cursor() as cursor, cursor.copy(query) as copy, path.open("wb") as file:
        for block in copy:
            file.write(block)
    return path


def _copy(
    connection: psycopg.Connection[Any], files: dict[str, Path]
) -> tuple[float, float, float]:
    """Seconds for COPY into new tables, for its commit, and for the indexes on top."""
    with connection.transaction():
        connection.execute("SET LOCAL search_path = ag_catalog, public")
        _graph_ddl.create(connection, FLOOR_GRAPH)
        connection.execute(
            "CREATE TABLE public.floor_vectors (LIKE public.detection_embeddings INCLUDING ALL)"
        )
        started = time.perf_counter()
        for label in LABELS:
            query = sql.SQL("COPY {} FROM STDIN").format(sql.Identifier(FLOOR_GRAPH, label))
            _feed(connection, query, files[label])
        query = sql.SQL("COPY public.floor_vectors FROM STDIN (FORMAT binary)").format()
        _feed(connection, query, files["vectors"])
        copied = time.perf_counter()
    committed = time.perf_counter()
    with connection.transaction():
        _graph_ddl.index(connection, FLOOR_GRAPH)
    indexed = time.perf_counter()
    connection.execute("DROP TABLE public.floor_vectors")
    with connection.transaction():
        _graph_ddl.drop(connection, FLOOR_GRAPH)
    return copied - started, committed - copied, indexed - committed


def _feed(connection: psycopg.Connection[Any], query: sql.Composed, path: Path) -> None:
    with connection.cursor() as cursor, cursor.copy(query) as copy, path.open("rb") as file:
        while block := file.read(1 << 18):
            copy.write(block)


def _read(log: Path) -> float:
    started = time.perf_counter()
    with LogReader(log) as reader:
        for _ in reader.read():
            pass
    return time.perf_counter() - started
