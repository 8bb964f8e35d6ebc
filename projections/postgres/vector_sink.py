"""The sink that writes searchable detections to the table ``detection_embeddings`` (pgvector), and
that table: create, find, change, lock, replace and index it.

The readers' table is in the schema ``public``, a rebuild's shadow in ``mapfold``, and a replaced
table in ``mapfold_old`` until it is dropped. A table or schema of ours carries our mark as its
comment. Anything else under our names is refused, never touched.

The HNSW index of a large table is built after the swap. Up to `EXACT_ROWS` exact search is fast
enough (measured: docs/projections.md) and gives the true answer. Beyond that the index is built
while readers go on with exact search and no tail runs. It is built by one process: pgvector before
0.8.2 can overflow a buffer in a parallel build (CVE-2026-3172), and the bundled one is 0.8.1. And
with enough memory: a graph that outgrows ``maintenance_work_mem`` is finished on disk, many times
slower.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import psycopg
from psycopg import sql
from psycopg.rows import TupleRow

from eventsrc.base.text import advised, counted
from projections.fold.map_errors import DatabaseError
from projections.map.changes import BatchChanges
from projections.map.view import MapView

from . import replaced_tables
from .connection import (
    Connection,
    describe_connection,
    ensure_extension,
    extension_version,
    statements,
)
from .labels import TABLE, SinkName
from .loader import Load, copy_vectors, insert_vectors
from .replaced_tables import copy_privileges, try_drop_lock, wait_for_drop
from .sink import PreparedWrite
from .vector_rows import VectorRow, new_rows

READERS: Final = "public"
"""The schema of the table that readers see."""
SHADOW: Final = "mapfold"
"""The schema of a rebuild's shadow."""
PLAIN_DIMENSION: Final = 1_900
"""Dimension up to which a row fits one page of 8 kB and can be kept out of TOAST."""
EXACT_ROWS: Final = 50_000
"""Rows up to which the table is searched exactly."""
INDEX_DIMENSION: Final = 4_000
"""pgvector's limit for an HNSW index on ``halfvec``."""
SAFE_PARALLEL: Final = (0, 8, 2)
"""The first version of pgvector whose parallel build is safe."""
_MARK: Final = "mapfold"
_MEGABYTE: Final = 1 << 20
_MAX_MEMORY_MB: Final = 4_096
DEFAULT_DIMENSION: Final = 512
SMALL_BATCH: Final = 20
"""Below this many rows an INSERT, sent down the pipeline, beats COPY's extra round trips."""


class VectorSink:
    """Implements `Sink` for the table ``detection_embeddings``.

    ``dimension`` is the column's when the table is created. It is the map's own: the first rows of
    another dimension change it.
    """

    name: Final[SinkName] = "vectors"

    def __init__(self, *, dimension: int | None = None) -> None:
        self._dimension = dimension or DEFAULT_DIMENSION
        self._type: sql.Composable = sql.Identifier("vector")

    def ensure(self, connection: Connection) -> bool:
        """Create the table if there is none; learn the dimension it has."""
        ensure_extension(connection, "vector")
        self._type = vector_type(connection)
        dimension = _declared_dimension(connection)
        if dimension is None:
            create_vectors(connection, READERS, self._type, self._dimension)
            return True
        self._dimension = dimension
        return False

    def prepare(self, changes: BatchChanges, view: MapView) -> PreparedWrite[Connection]:
        """Rows that a batch adds."""
        rows = new_rows(changes, view)
        is_small = len(rows) < SMALL_BATCH
        return PreparedWrite(partial(self._write, rows, is_small), is_small)

    def _write(self, rows: Sequence[VectorRow], is_small: bool, connection: Connection) -> None:
        if not rows:
            return
        dimension = len(rows[0].unit)
        if dimension != self._dimension:
            self._refuse_if_not_owner(connection, dimension)
            _redimension(connection, READERS, self._type, dimension)
            self._dimension = dimension
        if is_small:
            insert_vectors(READERS, self._type, rows)(connection)
        else:
            copy_vectors(READERS, rows)(connection)

    def drop_leftovers(self, connection: Connection) -> None:
        """Drop a replaced table that was left; refuse early if the name in use is not ours."""
        ensure_extension(connection, "vector")
        _declared_dimension(connection)
        if _has_old(connection) and try_drop_lock(connection, self.name):
            _drop_old(connection)

    def shadow(self) -> "VectorShadow":
        """A shadow, not created yet."""
        return VectorShadow(self._dimension)

    def drop_replaced(self, connection: Connection) -> None:
        """Have the replaced table dropped."""
        if _has_old(connection) and try_drop_lock(connection, self.name):
            _drop_old_in_background(connection)

    def _refuse_if_not_owner(self, connection: Connection, dimension: int) -> None:
        """Checked beforehand: in a pipeline the server's own refusal comes too late to explain."""
        if not _is_owner(connection):
            raise DatabaseError(
                f"{describe_connection(connection)}: the map's embeddings have {dimension}"
                f" dimensions, {TABLE} is for {self._dimension}, and only its owner may change"
                f" that; have the owner run `{advised('replay')}`, then start again"
            )


class VectorShadow:
    """Implements `Shadow`: the table ``mapfold.detection_embeddings``."""

    def __init__(self, dimension: int) -> None:
        self._dimension = dimension
        self._type: sql.Composable = sql.Identifier("vector")

    def create(self, connection: Connection) -> None:
        """Create an empty table."""
        self._type = vector_type(connection)
        create_vectors(connection, SHADOW, self._type, self._dimension)

    def load(self, changes: BatchChanges, view: MapView) -> Load:
        """Returns a function that writes the rows of new observations."""
        rows = new_rows(changes, view)
        if not rows:
            return lambda _: None
        dimension = len(rows[0].unit)
        add = copy_vectors(SHADOW, rows)

        def load(connection: Connection) -> None:
            if dimension != self._dimension:
                _redimension(connection, SHADOW, self._type, dimension)
                self._dimension = dimension
            add(connection)

        return load

    def finish(self, view: MapView) -> Callable[[Connection], Mapping[str, int]]:
        """Returns a function that gathers statistics and compares numbers. The keys' indexes are
        there already, HNSW is built after the swap."""
        expected = sum(o.embedding_crc is not None for o in view.observations)

        def finish(connection: Connection) -> Mapping[str, int]:
            analyze_vectors(connection, SHADOW)
            found = count_vectors(connection, SHADOW)
            if found != expected:
                raise DatabaseError(
                    f"{describe_connection(connection)}: the rebuilt table has {found} rows, the"
                    f" map {expected} searchable detections; the old one stays, please report this"
                )
            return {TABLE: found}

        return finish

    def lock_readers(self, connection: Connection) -> None:
        """Keep readers away from the table."""
        wait_for_drop(connection, VectorSink.name)
        if _declared_dimension(connection) is not None:
            _lock(connection)

    def swap_in(self, connection: Connection) -> None:
        """Put the shadow in the readers' place, open to the same roles."""
        if _declared_dimension(connection) is not None:
            copy_privileges(connection, READERS, SHADOW, table=TABLE)
            _set_aside(connection)
        _move_in(connection)


def vector_type(connection: Connection) -> sql.Identifier:
    """pgvector's type, with the schema that the extension is in."""
    return sql.Identifier(_extension_schema(connection), "vector")


def _declared_dimension(connection: Connection) -> int | None:
    """Declared dimension of the readers' table, or None. Raises DatabaseError if it is not ours."""
    row = connection.execute(
        statements("vectors")["state"], {"table": f"{READERS}.{TABLE}"}
    ).fetchone()
    if row is None:
        return None
    if not str(row[0]).startswith(_MARK):
        raise DatabaseError(
            f"{describe_connection(connection)}: has a table {TABLE} that mapfold did not"
            " make; rename or drop it, or use another database"
        )
    return int(row[1])


def create_vectors(
    connection: Connection, schema: str, vector: sql.Composable, dimension: int
) -> None:
    """An empty table. ``vector`` is `vector_type`."""
    _execute(connection, "create", schema, vector=vector, dimension=sql.Literal(dimension))
    _set_storage(connection, schema, dimension)


def _redimension(
    connection: Connection, schema: str, vector: sql.Composable, dimension: int
) -> None:
    """Change the dimension of an empty table; the server refuses if rows of another are there."""
    _execute(connection, "redimension", schema, vector=vector, dimension=sql.Literal(dimension))
    _set_storage(connection, schema, dimension)


def _is_owner(connection: Connection) -> bool:
    """Whether we may change the readers' table."""
    row = connection.execute(statements("vectors")["is_owner"]).fetchone()
    return row is None or bool(row[0])


def has_hnsw(connection: Connection) -> bool:
    """Whether the readers' table has the index of `build_hnsw`."""
    row = connection.execute(statements("vectors")["has_hnsw"]).fetchone()
    return row is not None and bool(row[0])


def count_vectors(connection: Connection, schema: str) -> int:
    """Rows."""
    row = _execute(connection, "count", schema).fetchone()
    return int(row[0]) if row else 0


def analyze_vectors(connection: Connection, schema: str) -> None:
    """Gather statistics. Inside a transaction."""
    connection.execute(statements("vectors")["sample"])
    _execute(connection, "analyze", schema)


def _lock(connection: Connection) -> None:
    """Lock the readers' table exclusively."""
    _execute(connection, "lock", READERS)


def _set_aside(connection: Connection) -> None:
    """Move the readers' table to ``mapfold_old``. Refuses if something depends on it."""
    try:
        with connection.transaction(force_rollback=True):
            _execute(connection, "drop", READERS)
    except psycopg.errors.DependentObjectsStillExist as error:
        raise DatabaseError(
            f"{describe_connection(connection)}: something else depends on {TABLE}"
            f" ({error.diag.message_detail}); drop it, then run the rebuild again"
        ) from None
    connection.execute(statements("vectors")["put_aside"])


def _move_in(connection: Connection) -> None:
    """Make the shadow the readers' table."""
    connection.execute(statements("vectors")["move"])


def _has_old(connection: Connection) -> bool:
    """Whether there is a replaced table. Raises DatabaseError if the schema is not ours."""
    row = connection.execute(statements("vectors")["old_state"]).fetchone()
    if row is not None and not str(row[0]).startswith(_MARK):
        raise DatabaseError(
            f"{describe_connection(connection)}: has a schema mapfold_old that mapfold did not"
            " make; rename or drop it, or use another database"
        )
    return row is not None


def _drop_old(connection: Connection) -> None:
    """Drop the replaced table."""
    connection.execute(statements("vectors")["drop_old"])


def _drop_old_in_background(connection: Connection) -> None:
    """Have the server drop the replaced table in the background; closes the connection."""
    replaced_tables.send_and_close(connection, statements("vectors")["drop_old"].format())


def _set_storage(connection: Connection, schema: str, dimension: int) -> None:
    _execute(connection, "plain" if dimension <= PLAIN_DIMENSION else "external", schema)


def _execute(
    connection: Connection, name: str, schema: str, **values: sql.Composable
) -> psycopg.Cursor[TupleRow]:
    statement = statements("vectors")[name]
    return connection.execute(statement.format(schema=sql.Identifier(schema), **values))


def _extension_schema(connection: Connection) -> str:
    row = connection.execute(statements("vectors")["extension_schema"]).fetchone()
    return str(row[0]) if row else "public"


@dataclass(frozen=True, slots=True)
class HnswReport:
    """``built`` is whether the index was made, ``reason`` why or why not, ``seconds`` the time it
    took."""

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
    schema = _extension_schema(connection)
    statement = statements("vectors")["hnsw"].format(
        halfvec=sql.Identifier(schema, "halfvec"),
        dimension=sql.Literal(dimension),
        opclass=sql.Identifier(schema, "halfvec_cosine_ops"),
    )
    with connection.transaction():
        _prepare(connection, rows, dimension)
        connection.execute(statement)
    return HnswReport(True, f"HNSW index over {counted(rows, 'row')}", time.monotonic() - started)


def _prepare(connection: Connection, rows: int, dimension: int) -> None:
    # A vector and its neighbour lists (m = 16) in memory, and a quarter on top.
    need = int(rows * (2 * dimension + 800) * 1.25) // _MEGABYTE + 64
    memory = sql.Literal(f"{min(need, _MAX_MEMORY_MB)}MB")
    connection.execute(sql.SQL("SET LOCAL maintenance_work_mem = {}").format(memory))
    version = extension_version(connection, "vector") or "0"
    if tuple(int(part) for part in version.split(".") if part.isdigit()) < SAFE_PARALLEL:
        connection.execute("SET LOCAL max_parallel_maintenance_workers = 0")
