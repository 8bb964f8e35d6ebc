"""Named numpy arrays and JSON values as bytes, and back. No code is ever run to read one.

    magic · SHA-256 of all that follows · zlib of (length of the index, index, arrays end to end)

The index is JSON: the JSON values, and for each array its dtype, shape and place. Only plain
number types are read; whatever else the bytes say is refused.
"""

import hashlib
import json
import math
import zlib
from typing import Any

import numpy as np

MAGIC = b"mapfold snapshot 1\n"
_TYPES = frozenset({"<i4", "<i8", "<f8", "|u1", "<u4", "|i1"})
_LENGTH_BYTES = 8
_MOST_UNFOLDED = 16
_SMALL_BYTES = 64 * 1024 * 1024
"""A snapshot that unfolds to more than this, and to more than so many times its size, is none of
ours: those measured unfold to four times their size."""


class NotAContainer(ValueError):
    """These bytes are no container, or a damaged one; the message says how."""


def pack(values: dict[str, Any]) -> bytes:
    """The bytes of a container."""
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
            raise TypeError(f"{name} is an array of {little.dtype.str}, which no snapshot holds")
        blobs.append(little.tobytes())
        arrays[name] = (little.dtype.str, little.shape, at)
        at += len(blobs[-1])
    index = json.dumps({"plain": plain, "arrays": arrays}, allow_nan=False).encode()
    body = zlib.compress(b"".join([len(index).to_bytes(_LENGTH_BYTES, "little"), index, *blobs]), 1)
    return MAGIC + hashlib.sha256(body).digest() + body


def unpack(data: bytes) -> dict[str, Any]:
    """What `pack` was given. Raises NotAContainer."""
    head = len(MAGIC) + hashlib.sha256().digest_size
    if not data.startswith(MAGIC):
        raise NotAContainer("it does not begin like a snapshot of this version")
    body = data[head:]
    if hashlib.sha256(body).digest() != data[len(MAGIC) : head]:
        raise NotAContainer("its checksum does not match")
    content = _decompress(body)
    start = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    index = json.loads(content[_LENGTH_BYTES:start])
    values: dict[str, Any] = index["plain"]
    for name, (dtype, shape, at) in index["arrays"].items():
        if dtype not in _TYPES:
            raise NotAContainer(f"{name} is of the type {dtype!r}")
        flat = np.frombuffer(content, dtype, math.prod(shape), start + at)
        values[name] = flat.reshape(shape).copy()
    return values


def _decompress(body: bytes) -> bytes:
    """At most as much as a snapshot may hold: the checksum is no proof against a forger."""
    most = max(_SMALL_BYTES, _MOST_UNFOLDED * len(body))
    stream = zlib.decompressobj()
    content = stream.decompress(body, most)
    if not stream.eof:
        raise NotAContainer(f"it is torn, or unfolds to more than {most:,} bytes")
    return content
