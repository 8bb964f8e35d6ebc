"""The HNSW index of a large table of embeddings, built after the swap.

Below the threshold exact search is fast enough (measured: docs/projections.md) and gives the true
answer. Above it the index is built while readers go on with exact search and no tail runs.

Built by one process: pgvector before 0.8.2 can overflow a buffer in a parallel build
(CVE-2026-3172), and the bundled one is 0.8.1. And with enough memory: a graph that outgrows
``maintenance_work_mem`` is finished on disk, many times slower.
"""

import time
from dataclasses import dataclass
from typing import Final

from psycopg import sql

from eventsrc.words import counted
from projections.postgres.connect import Connection, extension_version

from ._sql import statements

EXACT_ROWS: Final = 50_000
"""Up to this many rows the table is searched exactly."""
INDEX_DIMENSION: Final = 2_000
"""pgvector's limit for an HNSW index on ``vector``."""
SAFE_PARALLEL: Final = (0, 8, 2)
_MEGABYTE: Final = 1 << 20
_MAX_MEMORY_MB: Final = 4_096


@dataclass(frozen=True, slots=True)
class HnswReport:
    """``built`` says whether the index was made; ``reason`` why or why not; ``seconds`` it took."""

    built: bool
    reason: str
    seconds: float = 0.0


def build_hnsw(connection: Connection, *, threshold: int = EXACT_ROWS) -> HnswReport:
    """Build the index if the table is large enough for one. ``connection`` is in autocommit."""
    row = connection.execute(statements("vectors")["shape"]).fetchone()
    rows, dimension = (0, 0) if row is None else (int(row[0]), int(row[1]))
    if rows < threshold:
        searched = f"{counted(rows, 'row')} {'is' if rows == 1 else 'are'} searched exactly"
        return HnswReport(False, f"{searched} (index from {threshold:,})")
    if dimension > INDEX_DIMENSION:
        return HnswReport(False, f"{dimension:,} dimensions are beyond HNSW's {INDEX_DIMENSION}")
    started = time.monotonic()
    schema = connection.execute(statements("vectors")["extension_schema"]).fetchone()
    opclass = sql.Identifier(str(schema[0]) if schema else "public", "vector_cosine_ops")
    with connection.transaction():
        _prepare(connection, rows, dimension)
        connection.execute(statements("vectors")["hnsw"].format(opclass=opclass))
    return HnswReport(True, f"HNSW index over {counted(rows, 'row')}", time.monotonic() - started)


def _prepare(connection: Connection, rows: int, dimension: int) -> None:
    # A vector and its neighbour lists (m = 16) in memory, and a quarter on top.
    need = int(rows * (4 * dimension + 800) * 1.25) // _MEGABYTE + 64
    memory = sql.Literal(f"{min(need, _MAX_MEMORY_MB)}MB")
    connection.execute(sql.SQL("SET LOCAL maintenance_work_mem = {}").format(memory))
    version = extension_version(connection, "vector") or "0"
    if tuple(int(part) for part in version.split(".") if part.isdigit()) < SAFE_PARALLEL:
        connection.execute("SET LOCAL max_parallel_maintenance_workers = 0")
