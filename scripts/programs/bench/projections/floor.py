"""Lower bounds of a rebuild's time: COPY of the same rows from ready files, and reading the log.

Three bounds, each including the one before:

*   *bare*: COPY of all rows into new, empty tables that have the constraints and indexes which AGE
    and the table's definition bring, and reading every event of the log. No fold, no rows made
*   *kept*: making those tables, and the commit. With ``wal_level=minimal`` the commit
    writes the rows to disk. Server and settings are those of the rebuild
*   *served*: our own indexes, statistics and the counts: all that a
    rebuild leaves

A fourth, *bare by default*, is bare with the server's default of ``toast_tuple_target``, as CREATE
TABLE alone makes tables. The rebuild sets another one, which makes any COPY of these rows faster;
bare has it too.

The rebuild is the whole call: reading, folding, making rows, writing, indexes, checks, digest, the
swap and its commit. Each replaces a map of its own size, which the server drops afterwards; the
time of that is given too.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import psycopg
from psycopg import sql

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.parsed_log import default_workers
from projections.postgres import rebuild
from projections.postgres.connection import Targets, connect
from projections.postgres.embedded import EmbeddedServer
from projections.postgres.graph_sink import (
    analyze_graph,
    count_graph,
    create_graph,
    drop_graph,
    index_graph,
)
from projections.postgres.labels import GRAPH, LABELS, TABLE
from projections.postgres.replaced_tables import wait_for_drop
from projections.postgres.vector_sink import (
    analyze_vectors,
    count_vectors,
    create_vectors,
    vector_type,
)

from .world import DIM, make_log

FLOOR_GRAPH = "floor_map"
FLOOR_VECTORS = "floor_vectors"
REPEATS = 3


@dataclass(frozen=True)
class Seconds:
    """What a COPY of everything takes, by its parts."""

    creating: float
    copying: float
    indexing: float
    counting: float
    committing: float
    dropping: float


def against_floor(server: EmbeddedServer, folder: Path, quick: bool) -> None:
    """An in-process rebuild of 20,000 keyframes without HNSW, against its lower bounds."""
    size = 2_000 if quick else 20_000
    log = make_log(folder / f"log-{size}", size)
    targets = Targets(server.url, server.url)
    rebuild(log, targets, Settings(), hnsw=False)  # for the first one to replace
    wholes = {
        workers: min(_rebuild(log, targets, workers) for _ in range(REPEATS))
        for workers in sorted({0, 1, default_workers()})
    }
    with connect(server.url, autocommit=True) as connection:
        connection.execute("SET client_min_messages = warning")
        files = _dump(connection, folder)
        pairs = [
            (_copy(connection, files), _copy(connection, files, is_default=True))
            for _ in range(REPEATS)
        ]
    least, default = (_least(timed) for timed in zip(*pairs, strict=True))
    reading = min(_read(log) for _ in range(REPEATS))
    folding = min(_fold(log) for _ in range(REPEATS))
    _print(size, wholes, least, default.copying, reading, folding)


def _least(timed: Sequence[Seconds]) -> Seconds:
    return Seconds(*(min(getattr(t, field.name) for t in timed) for field in fields(Seconds)))


def _print(
    size: int,
    wholes: dict[int, float],
    least: Seconds,
    default_copying: float,
    reading: float,
    folding: float,
) -> None:
    bare = least.copying + reading
    default = default_copying + reading
    kept = bare + least.creating + least.committing
    served = kept + least.indexing + least.counting
    print(
        f"floor of {size} keyframes\n"
        f"  bare {bare:.2f} s = COPY {least.copying:.2f} + reading {reading:.2f}\n"
        f"  bare by default {default:.2f} s = COPY {default_copying:.2f} with the server's"
        f" toast_tuple_target + reading {reading:.2f}\n"
        f"  kept {kept:.2f} s = + tables {least.creating:.2f} + commit {least.committing:.2f}\n"
        f"  served {served:.2f} s = + indexes and statistics {least.indexing:.2f} + counts"
        f" {least.counting:.2f}\n"
        f"  reading and folding alone {folding:.2f} s; dropping as much, which is left to the"
        f" server, {least.dropping:.2f} s"
    )
    for workers, whole in wholes.items():
        print(
            f"  rebuild with {workers} workers {whole:.2f} s: bare × {whole / bare:.2f},"
            f" bare by default × {whole / default:.2f},"
            f" kept × {whole / kept:.2f}, served × {whole / served:.2f}"
        )


def _rebuild(log: Path, targets: Targets, workers: int = 0) -> float:
    seconds = rebuild(log, targets, Settings(), hnsw=False, workers=workers).total_s
    with connect(targets.graph_url) as connection:  # so that its time counts for no other step
        wait_for_drop(connection, "graph")
        wait_for_drop(connection, "vectors")
    return seconds


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
    connection: psycopg.Connection[Any], files: dict[str, Path], *, is_default: bool = False
) -> Seconds:
    """All in one transaction, as a rebuild does it; ``is_default`` for *bare by default*."""
    laps = [time.perf_counter()]

    def lap() -> None:
        laps.append(time.perf_counter())

    with connection.transaction():
        connection.execute("SET LOCAL search_path = ag_catalog, public")
        create_graph(connection, FLOOR_GRAPH)
        connection.execute("CREATE SCHEMA floor_vectors")
        vector = vector_type(connection)
        create_vectors(connection, FLOOR_VECTORS, vector, DIM)
        if is_default:
            table = sql.Identifier(FLOOR_VECTORS, TABLE)
            connection.execute(sql.SQL("ALTER TABLE {} RESET (toast_tuple_target)").format(table))
        lap()
        for label in LABELS:
            query = sql.SQL("COPY {} FROM STDIN").format(sql.Identifier(FLOOR_GRAPH, label))
            _feed(connection, query, files[label])
        query = sql.SQL("COPY {} FROM STDIN (FORMAT binary)").format(
            sql.Identifier(FLOOR_VECTORS, TABLE)
        )
        _feed(connection, query, files["vectors"])
        lap()
        index_graph(connection, FLOOR_GRAPH)
        analyze_graph(connection, FLOOR_GRAPH)
        analyze_vectors(connection, FLOOR_VECTORS)
        lap()
        count_graph(connection, FLOOR_GRAPH)
        count_vectors(connection, FLOOR_VECTORS)
        lap()
    lap()
    connection.execute("DROP SCHEMA floor_vectors CASCADE")
    with connection.transaction():
        drop_graph(connection, FLOOR_GRAPH)
    lap()
    return Seconds(*(after - before for before, after in pairwise(laps)))


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


def _fold(log: Path) -> float:
    started = time.perf_counter()
    with LogReader(log) as reader:
        fold_log(reader, Settings(), keep_embeddings=False)
    return time.perf_counter() - started
