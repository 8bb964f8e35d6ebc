"""JSON, and arrays as one binary answer: a JSON header, then the arrays back to back.

The answer is the length of the header in bytes (uint32, little-endian), the header as UTF-8 JSON,
zeros up to the first array, and the arrays in the order of ``arrays`` in the header. Each array
starts at a multiple of 8; its ``offset`` counts bytes from the start of the answer. All numbers are
little-endian, so a browser makes typed arrays of them without copying.
"""

import json
from collections.abc import Mapping
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Column: TypeAlias = NDArray[Any]
DTYPES: Final = {"i8": "<i8", "f8": "<f8", "f4": "<f4", "i4": "<i4", "u4": "<u4", "u1": "|u1"}
"""The types of arrays by the names in the header."""
_NAMES: Final = {np.dtype(code): name for name, code in DTYPES.items()}
_ALIGNED: Final = 8
_LENGTH_BYTES: Final = 4
_OFFSET_DIGITS: Final = 12


def encoded(document: Mapping[str, Any]) -> bytes:
    """Compact UTF-8 JSON; half a surrogate pair, which UTF-8 cannot hold, becomes a question
    mark."""
    return json.dumps(document, ensure_ascii=False, allow_nan=False).encode("utf-8", "replace")


def packed_arrays(header: Mapping[str, Any], columns: Mapping[str, Column]) -> bytes:
    """The binary answer; ``arrays`` is added to the header."""
    # The header names offsets, which depend on its length: room is kept for the longest ones.
    longest = _header(header, columns, 10**_OFFSET_DIGITS)
    start = _aligned(_LENGTH_BYTES + len(longest))
    head = _header(header, columns, start)
    parts = [len(head).to_bytes(_LENGTH_BYTES, "little"), head]
    parts.append(bytes(start - _LENGTH_BYTES - len(head)))
    for column in columns.values():
        parts += (column.tobytes(), bytes(_aligned(column.nbytes) - column.nbytes))
    return b"".join(parts)


def _header(header: Mapping[str, Any], columns: Mapping[str, Column], start: int) -> bytes:
    """The header of arrays that begin at ``start``."""
    placed = []
    for name, column in columns.items():
        dtype = _NAMES[column.dtype]
        placed.append({"name": name, "dtype": dtype, "length": len(column), "offset": start})
        start += _aligned(column.nbytes)
    return encoded({**header, "arrays": placed})


def _aligned(length: int) -> int:
    return -(-length // _ALIGNED) * _ALIGNED
