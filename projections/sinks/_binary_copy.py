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
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from projections.deltas import ObservationAdded
from projections.exact import to_float32

from .vector_rows import VectorRow

COPIED: Final = (
    "run_id", "keyframe_id", "map_x", "map_y", "map_yaw", "ingested_at",
    "det_pk", "confidence", "bbox", "det_id", "class_name", "embedding_model", "embedding",
)  # fmt: skip
"""The columns in the order of the fields: first those that a keyframe's rows have in common."""
_HEADER: Final = b"PGCOPY\n\xff\r\n\0" + struct.pack(">ii", 0, 0)
_TRAILER: Final = struct.pack(">h", -1)
_NULL: Final = struct.pack(">i", -1)
_POSTGRES_EPOCH_US: Final = 946_684_800_000_000
_FLOAT4_OID: Final = 700

_count = struct.Struct(">h").pack
_length = struct.Struct(">i").pack
_int64 = struct.Struct(">iq").pack
_pose = struct.Struct(">ididid").pack
_fixed = struct.Struct(">iqidiiiiiiifififif").pack
_vector = struct.Struct(">ihh").pack


def copy_document(rows: Sequence[VectorRow], first: bool, last: bool) -> bytes:
    """The bytes of ``rows``, with the header when they come first, the trailer when last."""
    parts: list[bytes | memoryview] = [_HEADER] if first else []
    keyframe, common = -1, b""
    for row, vector in zip(rows, _vectors(rows), strict=True):
        added = row.added
        if added.keyframe != keyframe:
            keyframe, common = added.keyframe, _common(row)
        names = _names(added.class_name, added.embedding_model)
        parts += (common, _own(row, added), _text(added.det_id), names, vector)
    if last:
        parts.append(_TRAILER)
    return b"".join(parts)


def _vectors(rows: Sequence[VectorRow]) -> list[memoryview]:
    """The vectors' fields. All are of one dimension, the table's, and made in one go."""
    if not rows:
        return []
    units = np.array([row.unit for row in rows])
    dim = units.shape[1]
    fields = np.empty((len(rows), 8 + 4 * dim), np.uint8)
    fields[:, :8] = np.frombuffer(_vector(4 + 4 * dim, dim, 0), np.uint8)
    fields[:, 8:].view(">f4")[:] = to_float32(units)
    flat, size = fields.reshape(-1).data, fields.shape[1]
    return [flat[start : start + size] for start in range(0, len(flat), size)]


def _common(row: VectorRow) -> bytes:
    return b"".join((
        _count(len(COPIED)),
        _text(row.added.run_id),
        _int64(8, row.added.keyframe_id),
        _NULL * 3 if row.pose is None else _numbers(row.pose),
        _int64(8, row.ingested_us - _POSTGRES_EPOCH_US),
    ))  # fmt: skip


def _own(row: VectorRow, added: ObservationAdded) -> bytes:
    try:
        return _own_with(added, *added.bbox)
    except OverflowError:  # a corner beyond float32
        return _own_with(added, *row.bbox)


def _own_with(added: ObservationAdded, x0: float, y0: float, x1: float, y1: float) -> bytes:
    key, confidence = added.observation + 1, added.confidence
    array = (52, 1, 0, _FLOAT4_OID, 4, 1)
    return _fixed(8, key, 8, confidence, *array, 4, x0, 4, y0, 4, x1, 4, y1)


def _numbers(pose: tuple[float, float, float]) -> bytes:
    x, y, yaw = pose
    return _pose(8, x, 8, y, 8, yaw)


def _text(value: str) -> bytes:
    data = value.encode()
    return _length(len(data)) + data


@lru_cache(maxsize=4096)
def _names(class_name: str, model: str | None) -> bytes:
    """What many rows say."""
    return _text(class_name) + (_NULL if model is None else _text(model))
