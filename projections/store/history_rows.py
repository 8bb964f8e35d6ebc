"""Records of a history made from rows of its tables."""

from collections.abc import Callable
from itertools import starmap
from typing import Any, TypeVar, cast

import msgspec
import numpy as np

from eventsrc.envelope.model import Offset
from projections.fold.deltas import (
    KeyframeAdded,
    KeyframeOrdinal,
    PlaceOrdinal,
    Pose,
)

from .columns import NONE, Array
from .lazy_rows import Items
from .neighbours import Posed
from .tables import Tables

_T = TypeVar("_T")
NEVER = Offset(2**63 - 1)
"""The offset of an event that has not happened."""
NO_PLACE = PlaceOrdinal(-1)
"""The value of `History.placed_in` for a keyframe in no place."""


def keyframes_of(tables: Tables, first: int, last: int) -> list[KeyframeAdded]:
    """The keyframes with these ordinals."""
    rows = enumerate(tables.rows("keyframe", first, last), first)
    return [
        KeyframeAdded(
            Offset(offset),
            KeyframeOrdinal(number),
            run,
            run_id,
            keyframe_id,
            timestamp,
            Pose(x_um, y_um, yaw) if posed else None,
            floor,
        )
        for number, (offset, run, run_id, keyframe_id, timestamp, posed, x_um, y_um, yaw, floor)
        in rows
    ]  # fmt: skip


def posed(tables: Tables) -> Posed:
    """The keyframes that have a pose."""
    numbers = np.flatnonzero(tables.column("keyframe", "posed"))
    x, y = (tables.integers("keyframe", each)[numbers] for each in ("x_um", "y_um"))
    codes, strings = tables.codes("keyframe", "floor")
    names: dict[str | None, int] = {}
    unique, first, inverse = np.unique(codes[numbers], return_index=True, return_inverse=True)
    number_of = np.zeros(len(unique), np.int64)
    for place in np.argsort(first).tolist():
        name = None if unique[place] == NONE else strings[unique[place]]
        number_of[place] = names.setdefault(name, len(names))
    offsets = tables.integers("keyframe", "offset")[numbers]
    return Posed(numbers, offsets, np.stack([x, y], axis=1), number_of[inverse])


def as_ints(array: Array) -> memoryview:
    """A sequence of Python integers."""
    found: Any = array
    return memoryview(found)


def placed_columns(tables: Tables, end: Offset | None = None) -> tuple[Array, Array]:
    """For each keyframe the event below ``end`` that placed it, and the place that it joined."""
    keyframes = tables.count("keyframe") if end is None else tables.before("keyframe", end)
    count = None if end is None else tables.before("placed", end)
    offsets = np.full(keyframes, NEVER, np.int64)
    places = np.full(keyframes, NO_PLACE, np.int64)
    placed = tables.column("placed", "keyframe", count)
    offsets[placed] = tables.column("placed", "offset", count)
    places[placed] = tables.column("placed", "place", count)
    return offsets, places


def items_of(
    tables: Tables, table: str, column: str, delta: Callable[..., _T], value: int
) -> list[_T]:
    """The rows of a table whose ``column`` has this value, as deltas in order."""
    if not tables.count(table):
        return []
    rows = tables.group(table, column)[value]
    if not len(rows):
        return []
    found = Items(
        rows,
        lambda of: list(starmap(delta, tables.rows_at(table, of))),
        lambda of: tables.integers(table, "offset")[of],
    )
    return cast("list[_T]", found)


def documents(tables: Tables, table: str, type_: type[_T], count: int | None = None) -> list[_T]:
    """The records of a table that stores them as JSON."""
    texts = tables.texts(table, "document", 0, tables.count(table) if count is None else count)
    decode = msgspec.json.Decoder(type_).decode
    return [decode(text or "") for text in texts]
