"""The port through which new rows reach a table in bulk, and its two implementations.

`CopyLoader` streams COPY, which is what a rebuild wants. `InsertLoader` sends one ``INSERT …
SELECT unnest`` per call, for servers and proxies that do not let COPY through, and for batches so
small that COPY's own round trips would cost more. Both write the same rows: one contract test
class runs on both.
"""

from collections.abc import Sequence
from typing import Final, Literal, Protocol, TypeAlias

from psycopg import sql

from projections.postgres.connect import Connection

from ._binary_copy import COPIED, copy_document
from ._sql import statements
from .graph_render import EdgeRow, VertexRow
from .labels import EdgeLabel, VertexLabel
from .vector_rows import VectorRow

LoaderName: TypeAlias = Literal["copy", "insert"]
INSERT_CHUNK: Final = 5_000
"""Rows of one INSERT: a statement's parameters are held in memory whole, on both sides."""
VECTOR_CHUNK: Final = 500
COPY_CHUNK: Final = 60
"""Vectors made and sent together: 128 kB, as psycopg sends it. Larger ones are slower, as their
memory is asked of the system anew each time."""


class Loader(Protocol):
    """Writes rows that are not there yet. ``connection`` is inside a transaction."""

    def vertices(
        self, connection: Connection, graph: str, label: VertexLabel, rows: Sequence[VertexRow]
    ) -> None:
        """Add vertices of one label."""

    def edges(
        self, connection: Connection, graph: str, label: EdgeLabel, rows: Sequence[EdgeRow]
    ) -> None:
        """Add edges of one label."""

    def vectors(
        self, connection: Connection, schema: str, vector: sql.Composable, rows: Sequence[VectorRow]
    ) -> None:
        """Add rows of ``detection_embeddings``; ``vector`` names pgvector's type."""


class CopyLoader:
    """COPY: text for the graph (agtype has no binary form), binary for the vectors."""

    def vertices(
        self, connection: Connection, graph: str, label: VertexLabel, rows: Sequence[VertexRow]
    ) -> None:
        """Add vertices of one label."""
        lines = [f"{i}\t{properties}\n" for i, properties in rows]
        self._copy(connection, "copy_vertex", graph, label, lines)

    def edges(
        self, connection: Connection, graph: str, label: EdgeLabel, rows: Sequence[EdgeRow]
    ) -> None:
        """Add edges of one label."""
        lines = [f"{i}\t{start}\t{end}\t{properties}\n" for i, start, end, properties in rows]
        self._copy(connection, "copy_edge", graph, label, lines)

    def vectors(
        self,
        connection: Connection,
        schema: str,
        vector: sql.Composable,  # noqa: ARG002 - COPY takes the type from the table
        rows: Sequence[VectorRow],
    ) -> None:
        """Add rows of ``detection_embeddings``."""
        statement = sql.SQL("COPY {}.detection_embeddings ({}) FROM STDIN (FORMAT binary)").format(
            sql.Identifier(schema), sql.SQL(", ").join(map(sql.Identifier, COPIED))
        )
        with connection.cursor() as cursor, cursor.copy(statement) as copy:
            for start in range(0, len(rows), COPY_CHUNK):
                last = start + COPY_CHUNK >= len(rows)
                copy.write(copy_document(rows[start : start + COPY_CHUNK], start == 0, last))

    def _copy(
        self, connection: Connection, statement: str, graph: str, label: str, lines: list[str]
    ) -> None:
        # agtype text holds no raw tab or line end (they are escaped in strings), so the backslash
        # is the only character that COPY's own format still has to escape.
        data = "".join(lines).replace("\\", "\\\\")
        query = statements("graph")[statement].format(
            graph=sql.Identifier(graph), label=sql.Identifier(label)
        )
        with connection.cursor() as cursor, cursor.copy(query) as copy:
            copy.write(data)


class InsertLoader:
    """``INSERT … SELECT unnest(…)`` with the columns as bound arrays."""

    def vertices(
        self, connection: Connection, graph: str, label: VertexLabel, rows: Sequence[VertexRow]
    ) -> None:
        """Add vertices of one label."""
        insert_columns(connection, "insert_vertex", graph, label, rows)

    def edges(
        self, connection: Connection, graph: str, label: EdgeLabel, rows: Sequence[EdgeRow]
    ) -> None:
        """Add edges of one label."""
        insert_columns(connection, "insert_edge", graph, label, rows)

    def vectors(
        self, connection: Connection, schema: str, vector: sql.Composable, rows: Sequence[VectorRow]
    ) -> None:
        """Add rows of ``detection_embeddings``."""
        query = statements("vectors")["insert"].format(schema=sql.Identifier(schema), vector=vector)
        for start in range(0, len(rows), VECTOR_CHUNK):
            chunk = rows[start : start + VECTOR_CHUNK]
            columns = zip(*(_vector_fields(row) for row in chunk), strict=True)
            connection.execute(query, [list(column) for column in columns])


def insert_columns(
    connection: Connection,
    statement: str,
    graph: str,
    label: str,
    rows: Sequence[VertexRow] | Sequence[EdgeRow],
) -> None:
    """Run one of the unnest statements of ``sql/graph.sql`` with the columns of ``rows``."""
    query = statements("graph")[statement].format(
        graph=sql.Identifier(graph), label=sql.Identifier(label)
    )
    for start in range(0, len(rows), INSERT_CHUNK):
        columns = zip(*rows[start : start + INSERT_CHUNK], strict=True)
        connection.execute(query, [[str(value) for value in column] for column in columns])


def loader_of(name: LoaderName) -> Loader:
    """The loader called ``name``."""
    return CopyLoader() if name == "copy" else InsertLoader()


def _vector_fields(row: VectorRow) -> tuple[object, ...]:
    pose = row.pose or (None, None, None)
    bbox = "{" + ",".join(map(repr, row.bbox)) + "}"
    embedding = "[" + ",".join(map(repr, row.embedding.tolist())) + "]"
    added = row.added
    return (
        row.det_pk, added.run_id, added.det_id, added.keyframe_id, added.class_name,
        added.confidence, bbox, *pose, added.embedding_model, embedding, row.ingested_at,
    )  # fmt: skip
