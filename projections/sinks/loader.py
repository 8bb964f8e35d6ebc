"""The port through which new rows reach a table in bulk, and its two implementations.

`CopyLoader` streams COPY, which is what a rebuild wants. `InsertLoader` sends one ``INSERT …
SELECT unnest`` per call, for servers and proxies that do not let COPY through, and for batches so
small that COPY's own round trips would cost more. Both write the same rows: one contract test
class runs on both.

A loader makes a `Load` of the rows: all that takes time in this process is done then, and what is
left is sending. A rebuild sends in a thread; were the thread to make bytes of rows too, it and the
fold would take the interpreter from each other tens of thousands of times, a fifth of both.
"""

from collections.abc import Callable, Sequence
from typing import Final, Literal, Protocol, TypeAlias

from psycopg import sql

from projections.postgres.connect import Connection

from ._binary_copy import COPIED, copy_document
from ._sql import statements
from .graph_render import EdgeRow, VertexRow
from .labels import EdgeLabel, VertexLabel
from .vector_rows import VectorRow

LoaderName: TypeAlias = Literal["copy", "insert"]
Load: TypeAlias = Callable[[Connection], None]
"""Sends rows that are not there yet; the connection is inside a transaction."""
TypeName: TypeAlias = Callable[[], sql.Composable]
"""Names pgvector's type. Asked when rows are sent: when they are made, a rebuild's other thread may
not have learnt yet in which schema the server has it."""
INSERT_CHUNK: Final = 5_000
"""Rows of one INSERT: a statement's parameters are held in memory whole, on both sides."""
VECTOR_CHUNK: Final = 500
COPY_CHUNK: Final = 60
"""Vectors made and sent together: 128 kB, as psycopg sends it. Larger ones are slower, as their
memory is asked of the system anew each time."""


class Loader(Protocol):
    """Makes what writes rows that are not there yet."""

    def vertices(self, graph: str, label: VertexLabel, rows: Sequence[VertexRow]) -> Load:
        """Add vertices of one label."""

    def edges(self, graph: str, label: EdgeLabel, rows: Sequence[EdgeRow]) -> Load:
        """Add edges of one label."""

    def vectors(self, schema: str, vector: TypeName, rows: Sequence[VectorRow]) -> Load:
        """Add rows of ``detection_embeddings``."""


class CopyLoader:
    """COPY: text for the graph (agtype has no binary form), binary for the vectors."""

    def vertices(self, graph: str, label: VertexLabel, rows: Sequence[VertexRow]) -> Load:
        """Add vertices of one label."""
        lines = [f"{i}\t{properties}\n" for i, properties in rows]
        return _copy(_about("copy_vertex", graph, label), [_text_document(lines)])

    def edges(self, graph: str, label: EdgeLabel, rows: Sequence[EdgeRow]) -> Load:
        """Add edges of one label."""
        lines = [f"{i}\t{start}\t{end}\t{properties}\n" for i, start, end, properties in rows]
        return _copy(_about("copy_edge", graph, label), [_text_document(lines)])

    def vectors(
        self,
        schema: str,
        vector: TypeName,  # noqa: ARG002 - COPY takes the type from the table
        rows: Sequence[VectorRow],
    ) -> Load:
        """Add rows of ``detection_embeddings``."""
        statement = sql.SQL("COPY {}.detection_embeddings ({}) FROM STDIN (FORMAT binary)").format(
            sql.Identifier(schema), sql.SQL(", ").join(map(sql.Identifier, COPIED))
        )
        starts = range(0, len(rows), COPY_CHUNK)
        return _copy(
            statement,
            [
                copy_document(rows[i : i + COPY_CHUNK], i == 0, i + COPY_CHUNK >= len(rows))
                for i in starts
            ],
        )


class InsertLoader:
    """``INSERT … SELECT unnest(…)`` with the columns as bound arrays."""

    def vertices(self, graph: str, label: VertexLabel, rows: Sequence[VertexRow]) -> Load:
        """Add vertices of one label."""
        return unnest_columns("insert_vertex", graph, label, rows)

    def edges(self, graph: str, label: EdgeLabel, rows: Sequence[EdgeRow]) -> Load:
        """Add edges of one label."""
        return unnest_columns("insert_edge", graph, label, rows)

    def vectors(self, schema: str, vector: TypeName, rows: Sequence[VectorRow]) -> Load:
        """Add rows of ``detection_embeddings``."""
        insert, where = statements("vectors")["insert"], sql.Identifier(schema)
        fields = [_vector_fields(row) for row in rows]
        return _unnest(lambda: insert.format(schema=where, vector=vector()), fields, VECTOR_CHUNK)


def unnest_columns(
    statement: str, graph: str, label: str, rows: Sequence[VertexRow] | Sequence[EdgeRow]
) -> Load:
    """One of the unnest statements of ``sql/graph.sql``, with the columns of ``rows``."""
    as_text = [tuple(map(str, row)) for row in rows]
    query = _about(statement, graph, label)
    return _unnest(lambda: query, as_text, INSERT_CHUNK)


def loader_of(name: LoaderName) -> Loader:
    """The loader called ``name``."""
    return CopyLoader() if name == "copy" else InsertLoader()


def _about(statement: str, graph: str, label: str) -> sql.Composed:
    return statements("graph")[statement].format(
        graph=sql.Identifier(graph), label=sql.Identifier(label)
    )


def _text_document(lines: list[str]) -> bytes:
    # agtype text holds no raw tab or line end (they are escaped in strings), so the backslash is
    # the only character that COPY's own format still has to escape.
    return "".join(lines).replace("\\", "\\\\").encode()


def _copy(statement: sql.Composed, documents: list[bytes]) -> Load:
    def load(connection: Connection) -> None:
        with connection.cursor() as cursor, cursor.copy(statement) as copy:
            for document in documents:
                copy.write(document)

    return load


def _unnest(
    statement: Callable[[], sql.Composed], rows: Sequence[tuple[object, ...]], size: int
) -> Load:
    """``size`` rows with one statement."""
    chunks = [
        [list(column) for column in zip(*rows[start : start + size], strict=True)]
        for start in range(0, len(rows), size)
    ]

    def load(connection: Connection) -> None:
        query = statement()
        for columns in chunks:
            connection.execute(query, columns)

    return load


def _vector_fields(row: VectorRow) -> tuple[object, ...]:
    pose = row.pose or (None, None, None)
    bbox = "{" + ",".join(map(repr, row.bbox)) + "}"
    embedding = "[" + ",".join(map(repr, row.embedding.tolist())) + "]"
    added = row.added
    return (
        row.det_pk, added.run_id, added.det_id, added.keyframe_id, added.class_name,
        added.confidence, bbox, *pose, added.embedding_model, embedding, row.ingested_at,
    )  # fmt: skip
