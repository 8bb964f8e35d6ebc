"""The state of a fold as bytes, and back. Reading one never runs code from it.

    magic · SHA-256 of all that follows · zlib of (length of the index, index, arrays end to end)

The index is JSON: the JSON values, and for each numpy array its dtype, shape and position.
Only plain number types are read; anything else is refused.
docs/decisions/history-cache.md says why this is not `numpy.savez`.
"""

import hashlib
import json
import math
import zlib
from typing import Any

import numpy as np

from projections.fold import State

MAGIC = b"mapfold snapshot 1\n"
_TYPES = frozenset({"<i2", "<i4", "<i8", "<f4", "<f8", "|u1", "<u4", "|i1"})
_LENGTH_BYTES = 8
_MAX_RATIO = 16
_ALWAYS_ALLOWED_BYTES = 64 * 1024 * 1024
"""A state that decompresses to more than this, and to more than `_MAX_RATIO` times its size, is
refused. Those measured decompress to four times their size."""


class MalformedState(ValueError):
    """Raised for bytes that are no state of this version, or a damaged one; the message says
    how."""


def pack(values: State) -> bytes:
    """Arrays and JSON values by name as bytes. Raises TypeError for an array of another type."""
    plain: dict[str, Any] = {}
    arrays: dict[str, tuple[str, tuple[int, ...], int]] = {}
    blobs: list[bytes] = []
    at = 0
    for name, value in values.items():
        if not isinstance(value, np.ndarray):
            plain[name] = value
            continue
        little = value.astype(value.dtype.newbyteorder("<"), copy=False)
        if little.dtype.str not in _TYPES:
            raise TypeError(f"{name} is an array of {little.dtype.str}, which no state file holds")
        blobs.append(little.tobytes())
        arrays[name] = (little.dtype.str, little.shape, at)
        at += len(blobs[-1])
    index = json.dumps({"plain": plain, "arrays": arrays}, allow_nan=False).encode()
    body = zlib.compress(b"".join([len(index).to_bytes(_LENGTH_BYTES, "little"), index, *blobs]), 1)
    return MAGIC + hashlib.sha256(body).digest() + body


def unpack(data: bytes) -> State:
    """The values of `pack`. Raises MalformedState."""
    head = len(MAGIC) + hashlib.sha256().digest_size
    if not data.startswith(MAGIC):
        raise MalformedState("it does not begin like a fold of this version")
    body = data[head:]
    if hashlib.sha256(body).digest() != data[len(MAGIC) : head]:
        raise MalformedState("its checksum does not match")
    content = _decompress(body)
    start = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    index = json.loads(content[_LENGTH_BYTES:start])
    values: State = index["plain"]
    for name, (dtype, shape, at) in index["arrays"].items():
        if dtype not in _TYPES:
            raise MalformedState(f"{name} is of the type {dtype!r}")
        flat = np.frombuffer(content, dtype, math.prod(shape), start + at)
        values[name] = flat.reshape(shape).copy()
    return values


def _decompress(body: bytes) -> bytes:
    """Decompress up to a limit: a forged file has a right checksum, too."""
    limit = max(_ALWAYS_ALLOWED_BYTES, _MAX_RATIO * len(body))
    stream = zlib.decompressobj()
    content = stream.decompress(body, limit)
    if not stream.eof:
        raise MalformedState(f"it is cut off, or decompresses to more than {limit:,} bytes")
    return content
