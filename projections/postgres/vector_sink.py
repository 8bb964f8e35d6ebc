"""The sink that writes searchable detections to ``detection_embeddings`` (pgvector)."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final

from psycopg import sql

from eventsrc.base.advised import advised
from projections.fold.errors import DatabaseError
from projections.map.changes import BatchChanges
from projections.map.view import MapView

from . import vector_table
from .connection import Connection, describe_connection, ensure_extension
from .grants import copy_privileges
from .labels import TABLE
from .loader import InsertLoader, Load, Loader, LoaderName, loader_of
from .replaced_tables import try_drop_lock, wait_for_drop
from .sink import PreparedWrite, SinkName
from .vector_rows import VectorRow, new_rows
from .vector_table import READERS, SHADOW

DEFAULT_DIMENSION: Final = 512
SMALL_BATCH: Final = 20
"""Below this many rows an INSERT, sent down the pipeline, beats COPY's extra round trips."""


class VectorSink:
    """Implements `LiveSink` and `RebuildSink` for the table ``detection_embeddings``.

    ``dimension`` is the column's when the table is created. It is the map's own: the first rows of
    another dimension change it.
    """

    name: Final[SinkName] = "vectors"

    def __init__(self, loader: LoaderName = "copy", *, dimension: int | None = None) -> None:
        self._loader: Loader = loader_of(loader)
        self._dimension = dimension or DEFAULT_DIMENSION
        self._type: sql.Composable = sql.Identifier("vector")

    def ensure(self, connection: Connection) -> bool:
        """Create the table if there is none; learn the dimension it has."""
        ensure_extension(connection, "vector")
        self._type = vector_table.vector_type(connection)
        dimension = vector_table.dimension(connection)
        if dimension is None:
            vector_table.create(connection, READERS, self._type, self._dimension)
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
            vector_table.redimension(connection, READERS, self._type, dimension)
            self._dimension = dimension
        loader = InsertLoader() if is_small else self._loader
        loader.vectors(READERS, lambda: self._type, rows)(connection)

    def drop_leftovers(self, connection: Connection) -> None:
        """Drop a replaced table that was left; refuse early if the name in use is not ours."""
        ensure_extension(connection, "vector")
        vector_table.dimension(connection)
        if vector_table.has_old(connection) and try_drop_lock(connection, self.name):
            vector_table.drop_old(connection)

    def shadow(self) -> "VectorShadow":
        """A shadow, not created yet."""
        return VectorShadow(self._loader, self._dimension)

    def drop_replaced(self, connection: Connection) -> None:
        """Have the replaced table dropped."""
        if vector_table.has_old(connection) and try_drop_lock(connection, self.name):
            vector_table.drop_old_in_background(connection)

    def _refuse_if_not_owner(self, connection: Connection, dimension: int) -> None:
        """Checked beforehand: in a pipeline the server's own refusal comes too late to explain."""
        if not vector_table.is_owner(connection):
            raise DatabaseError(
                f"{describe_connection(connection)}: the map's embeddings have {dimension}"
                f" dimensions, {TABLE} is for {self._dimension}, and only its owner may change"
                f" that; have the owner run `{advised('replay')}`, then start again"
            )


class VectorShadow:
    """Implements `Shadow`: the table ``mapfold.detection_embeddings``."""

    def __init__(self, loader: Loader, dimension: int) -> None:
        self._loader = loader
        self._dimension = dimension
        self._type: sql.Composable = sql.Identifier("vector")

    def create(self, connection: Connection) -> None:
        """Create an empty table."""
        self._type = vector_table.vector_type(connection)
        vector_table.create(connection, SHADOW, self._type, self._dimension)

    def load(self, changes: BatchChanges, view: MapView) -> Load:
        """Returns a function that writes the rows of new observations."""
        rows = new_rows(changes, view)
        if not rows:
            return lambda _: None
        dimension = len(rows[0].unit)
        add = self._loader.vectors(SHADOW, lambda: self._type, rows)

        def load(connection: Connection) -> None:
            if dimension != self._dimension:
                vector_table.redimension(connection, SHADOW, self._type, dimension)
                self._dimension = dimension
            add(connection)

        return load

    def finish(self, view: MapView) -> Callable[[Connection], Mapping[str, int]]:
        """Returns a function that gathers statistics and compares numbers. The keys' indexes are
        there already, HNSW is built after the swap."""
        expected = sum(o.embedding_crc is not None for o in view.observations)

        def finish(connection: Connection) -> Mapping[str, int]:
            vector_table.analyze(connection, SHADOW)
            found = vector_table.count(connection, SHADOW)
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
        if vector_table.dimension(connection) is not None:
            vector_table.lock(connection)

    def swap_in(self, connection: Connection) -> None:
        """Put the shadow in the readers' place, open to the same roles."""
        if vector_table.dimension(connection) is not None:
            copy_privileges(connection, READERS, SHADOW, table=TABLE)
            vector_table.set_aside(connection)
        vector_table.move_in(connection)
