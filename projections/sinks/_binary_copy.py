"""Rows of ``detection_embeddings`` in the binary format of COPY.

Written by hand because this is the bulk of a rebuild's bytes: 2 KiB of float32 per row go through
one numpy byte swap instead of a type adapter per field (18k rows/s there, several times that here).

The format (PostgreSQL manual, "COPY", Binary Format): a signature, flags and a header length; then
for each row an int16 number of fields and for each field an int32 length (-1 for NULL) and its
bytes as the type's ``recv`` function takes them; an int16 -1 ends it. All big-endian.

    bigint int64 · text UTF-8 · double precision float64 · timestamptz int64 µs since 2000-01-01
    real[] int32 dimensions, flags, element type's oid, length, lower bound, then length + float32
    vector int16 dimension, int16 0, float32 … (pgvector's vector_recv)
"""

import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from .vector_rows import COLUMNS, VectorRow

_HEADER: Final = b"PGCOPY\n\xff\r\n\0" + struct.pack(">ii", 0, 0)
_TRAILER: Final = struct.pack(">h", -1)
_NULL: Final = struct.pack(">i", -1)
_POSTGRES_EPOCH_US: Final = 946_684_800_000_000
_FLOAT4_OID: Final = 700

_first = struct.Struct(">hiq").pack
_int64 = struct.Struct(">iq").pack
_float64 = struct.Struct(">id").pack
_length = struct.Struct(">i").pack
_pose = struct.Struct(">ididid").pack
_bbox = struct.Struct(">iiiiiiifififif").pack
_vector = struct.Struct(">ihh").pack


def copy_document(rows: Sequence[VectorRow], first: bool, last: bool) -> bytes:
    """The bytes of ``rows``, with the header when they come first, the trailer when last."""
    parts = [_HEADER] if first else []
    for row, vector in zip(rows, _vectors(rows), strict=True):
        parts += _row(row, vector)
    if last:
        parts.append(_TRAILER)
    return b"".join(parts)


def _vectors(rows: Sequence[VectorRow]) -> Iterator[bytes]:
    """The vectors' fields. All are of one dimension, the table's, and swapped in one go."""
    if not rows:
        return
    dim = len(rows[0].embedding)
    head, size = _vector(4 + 4 * dim, dim, 0), 4 * dim
    swapped = np.array([row.embedding for row in rows], ">f4").tobytes()
    for start in range(0, len(swapped), size):
        yield head + swapped[start : start + size]


def _row(row: VectorRow, vector: bytes) -> tuple[bytes, ...]:
    x0, y0, x1, y1 = row.bbox
    return (
        _first(len(COLUMNS), 8, row.det_pk),
        _repeated_text(row.run_id),
        _text(row.det_id),
        _int64(8, row.keyframe_id),
        _repeated_text(row.class_name),
        _float64(8, row.confidence),
        _bbox(52, 1, 0, _FLOAT4_OID, 4, 1, 4, x0, 4, y0, 4, x1, 4, y1),
        _NULL * 3 if row.pose is None else _numbers(row.pose),
        _NULL if row.embedding_model is None else _repeated_text(row.embedding_model),
        vector,
        _int64(8, row.ingested_us - _POSTGRES_EPOCH_US),
    )


def _numbers(pose: tuple[float, float, float]) -> bytes:
    x, y, yaw = pose
    return _pose(8, x, 8, y, 8, yaw)


def _text(value: str) -> bytes:
    data = value.encode()
    return _length(len(data)) + data


_repeated_text = lru_cache(maxsize=4096)(_text)
"""For what many rows say: runs, classes, models."""
