"""The sink that writes searchable detections to ``detection_embeddings`` (pgvector).

The HNSW index of a large table of embeddings, built after the swap.

Below the threshold exact search is fast enough (measured: docs/projections.md) and gives the true
answer. Above it the index is built while readers go on with exact search and no tail runs.

Built by one process: pgvector before 0.8.2 can overflow a buffer in a parallel build
(CVE-2026-3172), and the bundled one is 0.8.1. And with enough memory: a graph that outgrows
``maintenance_work_mem`` is finished on disk, many times slower.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import psycopg
from psycopg import sql

from eventsrc.text import counted
from projections.deltas import Delta
from projections.errors import DatabaseError
from projections.model.view import MapView

from . import swap
from .connection import Connection, describe_connection, ensure_extension, extension_version
from .grants import copy_privileges
from .labels import TABLE
from .loader import InsertLoader, Load, Loader, LoaderName, loader_of
from .sink import SinkName
from .statements import statements
from .vector_rows import VectorRow, VectorRows

DEFAULT_DIMENSION: Final = 512
PLAIN_DIMENSION: Final = 1_900
"""Up to here a row fits one page of 8 kB and can be kept out of TOAST."""
STREAM_ROWS: Final = 1_000
SMALL_BATCH: Final = 20
"""Below this many rows an INSERT, sent down the pipeline, beats COPY's extra round trips."""
_PUBLIC: Final = "public"
_SHADOW: Final = "mapfold"
_MARK: Final = "mapfold"


class VectorSink:
    """The sink of the table ``detection_embeddings``. The declared dimension is the map's."""

    name: Final[SinkName] = "vectors"
    rebuilds_from_view: Final = False

    def __init__(self, loader: LoaderName = "copy", *, dimension: int | None = None) -> None:
        self._loader: Loader = loader_of(loader)
        self._dimension = dimension or DEFAULT_DIMENSION
        self._shadow_dimension = self._dimension
        self._rows = VectorRows()
        self._type: sql.Composable = sql.Identifier("vector")

    def note(self, deltas: Sequence[Delta], logged_ns: int, view: MapView) -> None:  # noqa: ARG002 - the port
        """Remember the rows that ``deltas`` add."""
        self._rows.note(deltas, logged_ns)

    def take(self, view: MapView) -> list[VectorRow]:
        """The rows added since the last take."""
        return self._rows.take(view)

    def ensure(self, connection: Connection) -> bool:
        """Create the table if there is none; learn the dimension it has."""
        self._find_type(connection)
        dimension = self._existing(connection)
        if dimension is None:
            self._create(connection, _PUBLIC, self._dimension)
            return True
        self._dimension = dimension
        return False

    def few(self, changes: Sequence[VectorRow]) -> bool:
        """True when the rows are so few that they are not worth a COPY."""
        return len(changes) < SMALL_BATCH

    def write(self, connection: Connection, changes: Sequence[VectorRow]) -> None:
        """Add the rows that were taken."""
        if not changes:
            return
        dimension = len(changes[0].unit)
        if dimension != self._dimension:
            self._refuse_if_not_owner(connection, dimension)
            self._redimension(connection, _PUBLIC, dimension)
            self._dimension = dimension
        loader = InsertLoader() if self.few(changes) else self._loader
        loader.vectors(_PUBLIC, lambda: self._type, changes)(connection)

    def clear(self, connection: Connection) -> None:
        """Drop a replaced table that was left; refuse early if the name in use is not ours."""
        self._find_type(connection)
        self._existing(connection)
        if self._has_old(connection) and swap.try_drop_lock(connection, self.name):
            connection.execute(statements("vectors")["drop_old"])

    def begin(self, connection: Connection) -> None:
        """Create an empty shadow table."""
        self._shadow_dimension = self._dimension
        self._create(connection, _SHADOW, self._dimension)

    def take_final(self, view: MapView) -> list[VectorRow] | None:
        """The waiting rows, if they are enough."""
        return self._rows.take(view) if self._rows.waiting >= STREAM_ROWS else None

    def take_rest(self, view: MapView) -> list[VectorRow]:
        """The rows that still wait."""
        return self._rows.take(view)

    def load(self, changes: Sequence[VectorRow]) -> Load:
        """What writes rows to the shadow."""
        if not changes:
            return lambda _: None
        dimension = len(changes[0].unit)
        add = self._loader.vectors(_SHADOW, lambda: self._type, changes)

        def load(connection: Connection) -> None:
            if dimension != self._shadow_dimension:
                self._redimension(connection, _SHADOW, dimension)
                self._shadow_dimension = dimension
            add(connection)

        return load

    def index(self, connection: Connection) -> None:
        """Only statistics: the keys' indexes are there, HNSW comes after the swap."""
        connection.execute(statements("vectors")["sample"])
        connection.execute(_statement("analyze", _SHADOW))

    def check(self, connection: Connection, view: MapView) -> Mapping[str, int]:
        """Compare counts."""
        found = self._count(connection, _SHADOW)
        expected = sum(o.embedding_crc is not None for o in view.observations)
        if found != expected:
            raise DatabaseError(
                f"{describe_connection(connection)}: the rebuilt table has {found} rows, the map"
                f" {expected} searchable detections; the old one stays, please report this"
            )
        return {TABLE: found}

    def lock(self, connection: Connection) -> None:
        """Keep readers away from the table."""
        swap.wait_for_drop(connection, self.name)
        if self._existing(connection) is not None:
            connection.execute(_statement("lock", _PUBLIC))

    def swap(self, connection: Connection) -> None:
        """Put the shadow in the readers' place, open to the same roles."""
        if self._existing(connection) is not None:
            copy_privileges(connection, _PUBLIC, _SHADOW, table=TABLE)
            self._refuse_dependents(connection)
            connection.execute(statements("vectors")["put_aside"])
        connection.execute(statements("vectors")["move"])
        self._dimension = self._shadow_dimension

    def tidy(self, connection: Connection) -> None:
        """Have the replaced table dropped."""
        if self._has_old(connection) and swap.try_drop_lock(connection, self.name):
            swap.send_and_close(connection, statements("vectors")["drop_old"].format())

    def _refuse_dependents(self, connection: Connection) -> None:
        try:
            with connection.transaction(force_rollback=True):
                connection.execute(_statement("drop", _PUBLIC))
        except psycopg.errors.DependentObjectsStillExist as error:
            raise DatabaseError(
                f"{describe_connection(connection)}: something else depends on {TABLE}"
                f" ({error.diag.message_detail}); drop it, then run the rebuild again"
            ) from None

    def _has_old(self, connection: Connection) -> bool:
        """Whether there is a replaced table. Refuses somebody else's schema of that name."""
        row = connection.execute(statements("vectors")["old_state"]).fetchone()
        if row is not None and not str(row[0]).startswith(_MARK):
            raise DatabaseError(
                f"{describe_connection(connection)}: has a schema mapfold_old that mapfold did not"
                " make; rename or drop it, or use another database"
            )
        return row is not None

    def _find_type(self, connection: Connection) -> None:
        ensure_extension(connection, "vector")
        row = connection.execute(statements("vectors")["extension_schema"]).fetchone()
        schema = str(row[0]) if row else _PUBLIC
        self._type = sql.Identifier(schema, "vector")

    def _existing(self, connection: Connection) -> int | None:
        """Declared dimension of the readers' table; None without one. Refuses somebody else's."""
        row = connection.execute(
            statements("vectors")["state"], {"table": f"{_PUBLIC}.{TABLE}"}
        ).fetchone()
        if row is None:
            return None
        if not str(row[0]).startswith(_MARK):
            raise DatabaseError(
                f"{describe_connection(connection)}: has a table {TABLE} that mapfold did not"
                " make; rename or drop it, or use another database"
            )
        return int(row[1])

    def _create(self, connection: Connection, schema: str, dimension: int) -> None:
        create = statements("vectors")["create"]
        connection.execute(create.format(**self._names(schema, dimension)))
        self._set_storage(connection, schema, dimension)

    def _redimension(self, connection: Connection, schema: str, dimension: int) -> None:
        """The map's space is known now; the server refuses if rows of another are there."""
        redimension = statements("vectors")["redimension"]
        connection.execute(redimension.format(**self._names(schema, dimension)))
        self._set_storage(connection, schema, dimension)

    def _refuse_if_not_owner(self, connection: Connection, dimension: int) -> None:
        """Asked beforehand: in a pipeline the server's own refusal comes too late to explain."""
        row = connection.execute(statements("vectors")["is_owner"]).fetchone()
        if row is not None and not row[0]:
            raise DatabaseError(
                f"{describe_connection(connection)}: the map's embeddings have {dimension}"
                " dimensions,"
                f" {TABLE} is for {self._dimension}, and only its owner may change that; have the"
                " owner run mapfold replay, then start again"
            )

    def _set_storage(self, connection: Connection, schema: str, dimension: int) -> None:
        kind = "plain" if dimension <= PLAIN_DIMENSION else "external"
        connection.execute(_statement(kind, schema))

    def _names(self, schema: str, dimension: int) -> dict[str, sql.Composable]:
        return {
            "schema": sql.Identifier(schema),
            "vector": self._type,
            "dimension": sql.Literal(dimension),
        }

    def _count(self, connection: Connection, schema: str) -> int:
        row = connection.execute(_statement("count", schema)).fetchone()
        return int(row[0]) if row else 0


def _statement(name: str, schema: str) -> sql.Composed:
    return statements("vectors")[name].format(schema=sql.Identifier(schema))


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
