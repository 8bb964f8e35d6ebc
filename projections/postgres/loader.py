"""Bulk insertion of new rows, in one of two ways that write the same.

Rebuilds and large batches are streamed by COPY. ``INSERT … SELECT unnest``, with the columns as
bound arrays, is for batches so small that COPY's own round trips would cost more.

A `Load` of rows is made when all work of this process is done, and only sending is left. A rebuild
sends in a thread; if the thread encoded rows too, it and the fold would take the interpreter from
each other tens of thousands of times, a fifth of the time of both.

Rows of ``detection_embeddings`` are encoded here in COPY's binary format, as they are most of a
rebuild's bytes: 2 KiB of float32 per row go through one numpy byte swap instead of a type adapter
per field (18k rows/s there, several times that here).

The format (PostgreSQL manual, "COPY", Binary Format): a signature, flags and a header length; then
for each row an int16 number of fields and for each field an int32 length (-1 for NULL) and its
bytes as the type's ``recv`` function takes them; an int16 -1 ends it. All big-endian.

    bigint int64 · text UTF-8 · double precision float64 · timestamptz int64 µs since 2000-01-01
    real[] int32 dimensions, flags, element type's oid, length, lower bound, then length + float32;
           double precision[] likewise
    vector int16 dimension, int16 0, float32 … (pgvector's vector_recv)
"""

import struct
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np
from psycopg import sql

from projections.fold.deltas import ObservationAdded
from projections.fold.exact import to_float32
from projections.localize.relocalize.camera import CameraValues

from .connection import Connection, statements
from .graph_rows import Row
from .labels import EDGE_LABELS, Label
from .vector_rows import VectorRow

COPIED: Final = (
    "run_id", "keyframe_id", "map_x", "map_y", "map_yaw", "camera", "ingested_at",
    "det_pk", "confidence", "bbox", "det_id", "class_name", "embedding_model", "embedding",
)  # fmt: skip
"""The columns in the order of the fields: first those that all rows of a keyframe share."""
_HEADER: Final = b"PGCOPY\n\xff\r\n\0" + struct.pack(">ii", 0, 0)
_TRAILER: Final = struct.pack(">h", -1)
_NULL: Final = struct.pack(">i", -1)
_POSTGRES_EPOCH_US: Final = 946_684_800_000_000
_FLOAT4_OID: Final = 700
_FLOAT8_OID: Final = 701

_count = struct.Struct(">h").pack
_length = struct.Struct(">i").pack
_int64 = struct.Struct(">iq").pack
_pose = struct.Struct(">ididid").pack
_REALS: Final = struct.pack(">iiiiii", 52, 1, 0, _FLOAT4_OID, 4, 1)
"""The field of a ``real[]`` of four, up to its first element."""
_fixed = struct.Struct(f">iqid{len(_REALS)}sififififi").pack
_vector = struct.Struct(">ihh").pack
_DOUBLES: Final = struct.pack(">iiiiii", 68, 1, 0, _FLOAT8_OID, 4, 1)
"""The field of a ``double precision[]`` of four, up to its first element."""
_doubles = struct.Struct(">idididid").pack


def copy_document(rows: Sequence[VectorRow], first: bool, last: bool) -> bytes:
    """``rows`` as bytes, with the header if they are the ``first``, the trailer if the ``last``."""
    parts: list[bytes | memoryview] = [_HEADER] if first else []
    keyframe, shared = -1, b""
    for row, vector in zip(rows, _vectors(rows), strict=True):
        added = row.added
        if added.keyframe != keyframe:
            keyframe, shared = added.keyframe, _shared_fields(row)
        det_id = added.det_id.encode()
        try:
            numbers = _numbers(added, added.bbox, len(det_id))
        except OverflowError:  # a corner beyond float32
            numbers = _numbers(added, row.bbox, len(det_id))
        names = _name_fields(added.class_name, added.embedding_model)
        parts += (shared, numbers, det_id, names, vector)
    if last:
        parts.append(_TRAILER)
    return b"".join(parts)


def _vectors(rows: Sequence[VectorRow]) -> list[memoryview]:
    """The fields of the vectors, encoded together; all have the table's dimension."""
    if not rows:
        return []
    units = np.array([row.unit for row in rows])
    dim = units.shape[1]
    fields = np.empty((len(rows), 8 + 4 * dim), np.uint8)
    fields[:, :8] = np.frombuffer(_vector(4 + 4 * dim, dim, 0), np.uint8)
    fields[:, 8:].view(">f4")[:] = to_float32(units)
    flat, size = fields.reshape(-1).data, fields.shape[1]
    return [flat[start : start + size] for start in range(0, len(flat), size)]


def _shared_fields(row: VectorRow) -> bytes:
    return b"".join((
        _count(len(COPIED)),
        _text(row.added.run_id),
        _int64(8, row.added.keyframe_id),
        _NULL * 3 if row.pose is None else _pose_fields(row.pose),
        _NULL if row.camera is None else _camera_field(row.camera),
        _int64(8, row.ingested_us - _POSTGRES_EPOCH_US),
    ))  # fmt: skip


def _numbers(
    added: ObservationAdded, bbox: tuple[float, float, float, float], id_length: int
) -> bytes:
    """The fields of numbers, and the length of the det_id, whose field is the next."""
    x0, y0, x1, y1 = bbox
    key = added.observation + 1
    return _fixed(8, key, 8, added.confidence, _REALS, 4, x0, 4, y0, 4, x1, 4, y1, id_length)


def _pose_fields(pose: tuple[float, float, float]) -> bytes:
    x, y, yaw = pose
    return _pose(8, x, 8, y, 8, yaw)


def _camera_field(camera: CameraValues) -> bytes:
    hfov_deg, width, height, yaw = camera
    return _DOUBLES + _doubles(8, hfov_deg, 8, width, 8, height, 8, yaw)


def _text(value: str) -> bytes:
    data = value.encode()
    return _length(len(data)) + data


@lru_cache(maxsize=4096)
def _name_fields(class_name: str, model: str | None) -> bytes:
    """Cached, as many rows have the same."""
    return _text(class_name) + (_NULL if model is None else _text(model))


Load: TypeAlias = Callable[[Connection], None]
"""Sends rows that are not in the table yet, inside a transaction."""
INSERT_CHUNK: Final = 5_000
"""Rows of one INSERT: client and server hold all of a statement's parameters in memory."""
VECTOR_CHUNK: Final = 500
COPY_CHUNK: Final = 60
"""Vectors encoded and sent together: 128 kB, psycopg's own size. Larger ones are slower, as their
memory is allocated by the system each time."""


def copy_to_graph(graph: str, label: Label, rows: Sequence[Row]) -> Load:
    """Copies vertices or edges of one label."""
    kind = "edge" if label in EDGE_LABELS else "vertex"
    # agtype text, which has no binary form, holds no raw tab or line end (they are escaped in
    # strings), so the backslash is the only character that COPY's own format still has to escape.
    line = "%d\t%d\t%d\t%s\n" if kind == "edge" else "%d\t%s\n"
    document = "".join([line % row for row in rows]).replace("\\", "\\\\").encode()
    return _copy(graph_statement(f"copy_{kind}", graph, label), [document])


def insert_into_graph(graph: str, label: Label, rows: Sequence[Row]) -> Load:
    """Inserts vertices or edges of one label."""
    kind = "edge" if label in EDGE_LABELS else "vertex"
    return unnest_columns(f"insert_{kind}", graph, label, rows)


def copy_vectors(schema: str, rows: Sequence[VectorRow]) -> Load:
    """Copies rows of ``detection_embeddings``."""
    statement = sql.SQL("COPY {}.detection_embeddings ({}) FROM STDIN (FORMAT binary)").format(
        sql.Identifier(schema), sql.SQL(", ").join(map(sql.Identifier, COPIED))
    )
    documents = [
        copy_document(rows[i : i + COPY_CHUNK], i == 0, i + COPY_CHUNK >= len(rows))
        for i in range(0, len(rows), COPY_CHUNK)
    ]
    return _copy(statement, documents)


def insert_vectors(schema: str, vector: sql.Composable, rows: Sequence[VectorRow]) -> Load:
    """Inserts rows of ``detection_embeddings``; ``vector`` is the name of pgvector's type."""
    insert = statements("vectors")["insert"].format(schema=sql.Identifier(schema), vector=vector)
    return _unnest(insert, [_vector_fields(row) for row in rows], VECTOR_CHUNK)


def unnest_columns(
    statement: str, graph: str, label: str, rows: Sequence[tuple[object, ...]]
) -> Load:
    """Runs one of the unnest statements of ``sql/graph.sql`` with the columns of ``rows``."""
    as_text = [tuple(map(str, row)) for row in rows]
    return _unnest(graph_statement(statement, graph, label), as_text, INSERT_CHUNK)


def graph_statement(
    statement: str, graph: str, label: str, **parts: sql.Composable
) -> sql.Composed:
    """A statement of ``sql/graph.sql`` for the table of a label, with further parts in braces."""
    return statements("graph")[statement].format(
        graph=sql.Identifier(graph), label=sql.Identifier(label), **parts
    )


def _copy(statement: sql.Composed, documents: list[bytes]) -> Load:
    def load(connection: Connection) -> None:
        with connection.cursor() as cursor, cursor.copy(statement) as copy:
            for document in documents:
                copy.write(document)

    return load


def _unnest(statement: sql.Composed, rows: Sequence[tuple[object, ...]], size: int) -> Load:
    """One statement for each ``size`` rows."""
    chunks = [
        [list(column) for column in zip(*rows[start : start + size], strict=True)]
        for start in range(0, len(rows), size)
    ]

    def load(connection: Connection) -> None:
        for columns in chunks:
            connection.execute(statement, columns)

    return load


def _vector_fields(row: VectorRow) -> tuple[object, ...]:
    pose = row.pose or (None, None, None)
    bbox = "{" + ",".join(map(repr, row.bbox)) + "}"
    camera = None if row.camera is None else "{" + ",".join(map(repr, row.camera)) + "}"
    embedding = "[" + ",".join(map(repr, row.embedding.tolist())) + "]"
    added = row.added
    return (
        row.det_pk, added.run_id, added.det_id, added.keyframe_id, added.class_name,
        added.confidence, bbox, *pose, camera, added.embedding_model, embedding, row.ingested_at,
    )  # fmt: skip
